"""An arm offered on the myCobot's own wire, with a controller behind it."""
