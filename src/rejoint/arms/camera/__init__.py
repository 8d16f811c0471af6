"""Board, lens, and poses of camera, board and arm.

Board frame (OpenCV): x right, y down from the upper left corner. Camera frame: x right, y down, z forwards. Pixel
centres are whole numbers.
"""
