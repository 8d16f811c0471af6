"""Many arms in one call: which there are, when each may move, what is left to do of each, and who does it."""
