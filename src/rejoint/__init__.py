"""Give a worn robot arm its accuracy back, in software."""

from importlib.metadata import version

__version__ = version("rejoint")
