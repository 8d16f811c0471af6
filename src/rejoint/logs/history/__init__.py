"""Summary rows of runs and checks in Parquet."""
