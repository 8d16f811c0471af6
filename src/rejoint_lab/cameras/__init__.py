"""Simulated images of a board."""
