"""A camera that sees a ChArUco board: board, views, lens, one bundle adjustment, and the tool in a single picture.

Frames. The board's is that of OpenCV: x to the right and y down along its picture, origin at its upper left corner, z
away from whoever looks at it. The camera's: x to the right, y down, z forwards. Pixels have their centres at whole
numbers. Either the board is mounted on the tool and the camera stands beside the arm, or the other way round.
"""
