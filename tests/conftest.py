"""What holds for all tests."""

from hypothesis import HealthCheck, settings

# The same cases in every run, and no test fails since the machine was slow.
settings.register_profile("rejoint", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("rejoint")
