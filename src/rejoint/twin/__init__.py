"""The fitted model of an arm."""
