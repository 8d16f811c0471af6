"""A repair: its folder, its stages, its history, what leaves it, and many of them at once."""
