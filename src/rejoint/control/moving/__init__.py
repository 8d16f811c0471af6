"""Targets that move: paths, streams, the controller that follows them, and what is learned by repeating."""
