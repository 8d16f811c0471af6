"""A run for other runtimes: an ONNX graph and a ROS 2 node."""
