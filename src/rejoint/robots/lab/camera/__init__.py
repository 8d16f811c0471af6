"""Simulated pictures: a board rendered through a known lens, before an arm whose true tool is known."""
