"""A camera and a ChArUco board: views, bundle adjustment, camera setup, tool in single pictures."""
