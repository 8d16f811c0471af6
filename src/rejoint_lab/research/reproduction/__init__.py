"""Experiments of Park, Lee, Kim and Ahn 2024, IEEE Access, https://doi.org/10.1109/ACCESS.2024.3359268."""
