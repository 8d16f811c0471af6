"""What drives an arm: interfaces, controllers, the guard and the control loop."""
