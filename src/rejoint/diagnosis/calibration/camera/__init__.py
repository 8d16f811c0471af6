"""A camera that sees a ChArUco board: views, one bundle adjustment, its rig file, the tool in a single picture."""
