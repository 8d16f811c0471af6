"""The history as its owner sees it: rows of checks and runs, the table, the page, and what Prometheus reads."""
