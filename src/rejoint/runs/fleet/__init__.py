"""Many arms in one call."""
