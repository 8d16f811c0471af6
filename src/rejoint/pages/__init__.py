"""The report with its figures, and the live view."""
