"""Summary rows of runs and checks in Parquet: written one file each, read together, without a service."""
