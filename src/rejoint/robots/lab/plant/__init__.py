"""The simulated worn arm: firmware, motor, friction, play, flex, and channel.

It shares no physics code with `rejoint.twin`: a model fitted to itself would prove nothing.
"""
