"""Simulated reality: worn arms, their firmware and servers. Only drivers use it."""
