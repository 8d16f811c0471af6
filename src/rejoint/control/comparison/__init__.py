"""Comparison of controllers on one arm."""
