"""A camera that sees a ChArUco board: views, one bundle adjustment, its rig file, and the tool in a single picture.

Frames are those of `rejoint.arms.camera`.
"""
