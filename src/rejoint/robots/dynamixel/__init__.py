"""Arms on ROBOTIS Dynamixel X servos (protocol 2.0): Koch, WidowX, ViperX, OpenMANIPULATOR."""
