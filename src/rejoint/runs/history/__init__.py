"""What runs and checks leave for later: summary rows in Parquet, read in place, without a service."""
