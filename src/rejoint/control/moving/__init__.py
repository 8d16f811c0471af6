"""Targets that move: paths, streams, what follows them, and learning by repetition."""
