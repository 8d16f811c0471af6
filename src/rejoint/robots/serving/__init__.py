"""An arm offered to other programs on the myCobot's own wire, with a controller behind it instead of bare servos."""
