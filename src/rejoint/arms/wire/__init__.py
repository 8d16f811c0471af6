"""The myCobot's wire protocol from the robot's side, as pure functions."""
