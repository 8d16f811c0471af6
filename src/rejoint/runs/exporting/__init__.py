"""What a run has made of its arm, for other runtimes: an ONNX graph and a ROS 2 node."""
