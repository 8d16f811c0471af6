"""A worn arm behind its wire."""
