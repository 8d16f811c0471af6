"""Rivals of the policy: tuned classical and adaptive control."""
