"""Rivals of the learned policy: tuned classical laws and adaptive control."""
