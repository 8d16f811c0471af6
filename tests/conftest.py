"""What holds for all tests."""

import signal

from hypothesis import HealthCheck, settings

# The same cases in every run, and no test fails since the machine was slow.
settings.register_profile("rejoint", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("rejoint")

# A shell lets what it starts in the background ignore Ctrl-C; what tests start would inherit that.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
