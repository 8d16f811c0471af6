"""A camera and a printed board as measuring device: everything of that feature, on OpenCV.

Board frame (OpenCV): x right, y down from the upper left corner. Camera frame: x right, y down, z forwards. Pixel
centres are whole numbers.
"""

from rejoint.system.extras import require

require("a camera", "camera")
