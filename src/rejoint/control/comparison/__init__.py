"""Every controller on the same arm: protocols, metrics, intervals, recommendation."""
