"""The compiled step of free twins."""
