"""The simulated worn arm: servo firmware, motor, friction, play, flex, and the channel to it.

It stands for reality, and shares no physics code with `rejoint.twin`: a model that is fitted to itself would prove
nothing.
"""
