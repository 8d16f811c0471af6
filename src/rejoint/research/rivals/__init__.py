"""Rivals of the learned policy, built as if they were to win: tuned classical laws, adaptive and predictive control."""
