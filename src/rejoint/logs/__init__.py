"""Foreign logs into run logs, and run logs to CSV and MCAP."""
