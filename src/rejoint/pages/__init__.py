"""What people look at: the report with its figures, and the live view."""
