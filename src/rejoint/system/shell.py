"""Commands of ours as a shell takes them."""

from __future__ import annotations

import shlex


def command(*words: object) -> str:
    """Return ``rejoint`` with ``words`` for a shell: an address may hold an &, the name of a folder blanks."""
    return shlex.join(["rejoint", *map(str, words)])
