"""Targets that move, and what drives achieve."""
