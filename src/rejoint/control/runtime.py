"""ONNX Runtime, which tells nobody of an arm.

Its official builds report each session to their maker over the network, and keep a number of this machine in the home
folder, unless this is switched off before they are loaded. Whoever wants that sets the variable to 0.
"""

import os

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

import onnxruntime as ort

__all__ = ["ort"]
