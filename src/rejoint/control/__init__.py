"""Interfaces, controllers, the guard and the control loop."""
