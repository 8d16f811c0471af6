"""An observer made of functions, for what a test wants to hear."""

from collections.abc import Callable
from typing import Any

import rejoint


class Hears(rejoint.Observer):
    """Hands what it receives to the functions that it is given."""

    def __init__(self, **functions: Callable[..., Any]) -> None:
        for name, function in functions.items():
            assert hasattr(rejoint.Observer, name)
            setattr(self, name, function)
