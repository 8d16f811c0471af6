"""What a run has made of its arm, for runtimes that know nothing of this package: an ONNX graph and a ROS 2 node."""
