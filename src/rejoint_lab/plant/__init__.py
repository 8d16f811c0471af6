"""The simulated worn arm.

It shares no physics with `rejoint.twin`: a model fitted to itself would prove nothing.
"""
