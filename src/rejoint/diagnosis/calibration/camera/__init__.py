"""A camera and a ChArUco board: bundle adjustment, camera setup, tool in single pictures."""
