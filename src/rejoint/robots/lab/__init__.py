"""Simulated reality: worn arms, and the firmware and servers that speak for them. Only a driver opens this door."""
