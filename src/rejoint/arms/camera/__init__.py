"""A printed board, a lens, and the poses of camera, board and arm.

Board frame (OpenCV): x right, y down, origin at the upper left corner, z away from the viewer. Camera frame: x right, y
down, z forwards. Pixel centres are whole numbers.
"""
