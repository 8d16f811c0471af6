"""Free memory goes back to the system where the C library can do it."""

import platform

import pytest

from commandline import python

LEFT = """
from rejoint.system.shell import give_back

def resident():
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("VmRSS"))

pieces = [bytes(1000) for _ in range(100_000)]  # a hundred megabytes, with a piece in use at their end
last = pieces.pop()
full = resident()
del pieces
kept = resident()
give_back()
print(full, kept, resident())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="this C library cannot")
def test_what_is_free_below_something_in_use_is_given_back():
    full, kept, left = map(int, python("-c", LEFT).out.split())
    assert kept > full - 10_000
    assert left < full - 80_000
