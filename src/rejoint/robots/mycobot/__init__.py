"""The myCobot 280: its driver (`bus`), and its wire protocol from the robot's side (the rest), as pure functions."""
