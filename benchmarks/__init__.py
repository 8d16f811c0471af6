"""Speed measured side by side; run with `make bench`."""
