"""What is wrong with an arm: excitation, measurements per joint, and a verdict in words."""
