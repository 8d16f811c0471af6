"""The simulated worn arm: servo firmware, motor, friction, play, flex and the channel to it."""
