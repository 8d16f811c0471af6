"""What every room stands on: errors, files written whole, being asked to stop, and what is installed."""
