"""An arm offered to other programs on the myCobot's own wire, with a controller behind it instead of bare servos.

The control loop runs in one thread, under the guard, at the arm's period (`drive`); the wire is answered in another,
from the last state (`server`, `answering`). Between the two stands `ServedArm`, the computer that clients believe to
speak to. What was ordered and what became of it is written as it comes (`orderlog`).
"""
