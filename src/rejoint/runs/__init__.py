"""A repair: its folder, its stages, the trials on the arm, and the report."""
