"""Run the command line with ``python -m rejoint``."""

from rejoint.cli import main

main()
