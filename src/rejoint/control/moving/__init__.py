"""Targets that move."""
