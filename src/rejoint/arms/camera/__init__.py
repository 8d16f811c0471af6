"""What a camera sees an arm by: a printed board, the lens, and how camera, board and arm stand to each other.

Frames. The board's is that of OpenCV: x to the right and y down along its picture, origin at its upper left corner, z
away from whoever looks at it. The camera's: x to the right, y down, z forwards. Pixels have their centres at whole
numbers. Either the board is mounted on the tool and the camera stands beside the arm, or the other way round.
"""
