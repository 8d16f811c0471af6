"""The simulated worn arm: servo firmware, motor, friction, play, flex, and the channel to it.

The plant stands for reality. It shares no physics code with `rejoint.twin` and neither imports the
other, on purpose: the plant is richer than the twin can express, and a model that is fitted to
itself would prove nothing.
"""
