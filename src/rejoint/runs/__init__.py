"""A repair: folder, stages, history, exports, fleets."""
