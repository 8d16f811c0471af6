"""ONNX Runtime without its telemetry; the variable set to 0 allows it."""

import os

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

import onnxruntime as ort

__all__ = ["ort"]
