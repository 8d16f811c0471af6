"""The folder of a run: where each stage leaves its files, and the small ones that several read."""
