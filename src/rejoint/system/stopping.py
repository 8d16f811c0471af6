"""Interruption: a signal handler only sets a flag.

The vendor's client would swallow its exception. While an arm is driven (`noted`), loop, link and waits look at the flag
(`check`, `pause`) and raise `Interrupted`. The host program's handlers are called too.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from types import FrameType
from typing import ClassVar, TypeAlias

SIGNALS: tuple[int, ...] = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that end a program"""

# [s] after which a signal is sent again whose exception was swallowed (chosen: the callback is over by then)
_AGAIN = 0.1
# [s] between two looks at the note during a wait (chosen: a tenth of the usual control period)
_SLICE = 0.005
# Modules whose handler of Ctrl-C only cancels a task at its next await
_CANCELLING = ("asyncio.runners", "ipykernel.ipkernel")


Handler: TypeAlias = "Callable[[int, FrameType | None], object] | int | None"
"""As of `signal.getsignal`"""


class Interrupted(KeyboardInterrupt):
    """The end was asked for: by Ctrl-C, a signal, or `ask`."""

    def __init__(self, signum: int, by: str = "") -> None:
        self.signum, self.by = signum, by
        super().__init__(f"interrupted by {by or signal.Signals(signum).name}")

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle with all fields."""
        return type(self), (self.signum, self.by), self.__dict__

    @property
    def exit_code(self) -> int:
        """Exit code of a signal: 130 for Ctrl-C, 143 for SIGTERM."""
        return 128 + self.signum


class _Note:
    signum = 0
    by = ""
    hosts: BaseException | None = None
    """exception of the host program's handler; for the main thread"""
    raised: Interrupted | None = None
    heard: ClassVar[set[int]] = set()
    """threads that have raised it"""
    noted = 0
    shielded = 0
    hook: Callable[[sys.UnraisableHookArgs], object] = staticmethod(sys.__unraisablehook__)


_note = _Note()


def install() -> None:
    """Handle all `SIGNALS` that the parent does not ignore (`nohup`)."""
    _note.raised = None
    if not _note.noted:
        _drop()  # a command is not ended by what was asked of one before it
    _answer_all(_handle)
    if sys.unraisablehook is not _unraisable:
        _note.hook, sys.unraisablehook = sys.unraisablehook, _unraisable


def close() -> None:
    """Ignore further signals: the program is ending."""
    _answer_all(_pass_over)


def ignore() -> None:
    """Ignore signals for good: the result decides the exit code."""
    _answer_all(signal.SIG_IGN)


def _answer_all(handler: Handler) -> None:
    """Set the handler of all `SIGNALS` that are not ignored."""
    for signum in SIGNALS:
        if signal.getsignal(signum) != signal.SIG_IGN:
            signal.signal(signum, handler)


def ending() -> bool:
    """Whether this is inside `shielded`."""
    return bool(_note.shielded)


def check() -> None:
    """Raise `Interrupted` if asked for, once per driving thread; not inside `shielded`."""
    if _note.signum and not _note.shielded and threading.get_ident() not in _note.heard:
        _note.raised, hosts = Interrupted(_note.signum, _note.by), _note.hosts
        _note.heard.add(threading.get_ident())
        if not _note.noted:
            _drop()
        if hosts is not None and threading.current_thread() is threading.main_thread():
            _note.raised = None
            raise hosts
        raise _note.raised


def ask(by: str) -> None:
    """Ask for the end from any thread; ``by`` says who."""
    if not _note.signum:
        _note.by, _note.signum = by, signal.SIGINT
    _note.heard.clear()
    handled = [signum for signum in SIGNALS if signal.getsignal(signum) is _handle]
    if not _note.noted and handled:
        os.kill(os.getpid(), handled[0])


def interrupt(by: str = "the program") -> bool:
    """Bring all arms of this process to a hold, from any thread.

    The calls that drive them raise `Interrupted` with ``by``. Returns whether any arm was driven.

    Examples
    --------
    >>> threading.Thread(target=rejoint.deploy, args=("tcp://192.168.1.20:9000",)).start()
    >>> rejoint.interrupt("the button")
    """
    if not _note.noted:
        return False
    ask(by)
    return True


def _drop() -> None:
    _note.signum, _note.by, _note.hosts = 0, "", None
    _note.heard.clear()


def raise_again() -> None:
    """Raise a swallowed interruption again, in the main thread."""
    raised, main = _note.raised, threading.current_thread() is threading.main_thread()
    hears = main and any(signal.getsignal(signum) is _handle for signum in SIGNALS)
    if raised is not None and hears and not _note.noted and sys.exc_info()[1] is None:
        raise raised


def interruption() -> Interrupted | None:
    """Last interruption since `install`, or None."""
    return _note.raised


def pause(duration: float) -> None:
    """Wait for ``duration`` [s]; raises `Interrupted`."""
    until = time.monotonic() + duration
    check()
    while (left := until - time.monotonic()) > 0.0:
        time.sleep(min(left, _SLICE))
        check()


@contextmanager
def noted() -> Iterator[None]:
    """Keep signals to a flag inside; raise at the end if unchecked."""
    before = _set_handlers()
    _note.noted += 1
    try:
        yield
    except BaseException:
        if _note.noted == 1:
            _drop()  # the end has come for another reason
        raise
    finally:
        _note.noted -= 1
        for signum, handler in before.items():
            signal.signal(signum, handler)
    if not _note.noted:
        try:
            check()
        finally:
            _drop()


@contextmanager
def shielded() -> Iterator[None]:
    """Suppress `check` and `pause` inside, while the arm is brought to rest."""
    _note.shielded += 1
    try:
        with noted():
            yield
    finally:
        _note.shielded -= 1


def _handle(signum: int, frame: FrameType | None) -> None:  # noqa: ARG001 - as `signal` calls it
    _note.signum = _note.signum or signum
    _note.heard.clear()
    if not _note.noted:
        check()


def _pass_over(signum: int, frame: FrameType | None) -> None:
    """Do nothing; child processes do not inherit this."""


def _unraisable(unraisable: sys.UnraisableHookArgs) -> None:
    if isinstance(unraisable.exc_value, Interrupted):
        again = threading.Timer(_AGAIN, os.kill, (os.getpid(), unraisable.exc_value.signum))
        again.daemon = True
        again.start()
    else:
        _note.hook(unraisable)


def _hosts(handler: Callable[[int, FrameType | None], object], signum: int, frame: FrameType | None) -> None:
    """Call a handler of the host program."""
    try:
        handler(signum, frame)
    except BaseException as error:  # noqa: BLE001 - raised again by `check`
        _note.hosts = error
        _handle(signum, frame)


def _set_handlers() -> dict[int, Handler]:
    if threading.current_thread() is not threading.main_thread():
        return {}
    before = {}
    for signum in SIGNALS:
        handler = signal.getsignal(signum)
        inner = getattr(handler, "func", handler)
        if handler in (signal.SIG_DFL, signal.default_int_handler) or getattr(inner, "__module__", None) in _CANCELLING:
            before[signum] = signal.signal(signum, _handle)
        elif callable(handler) and inner not in (_handle, _pass_over, _hosts):
            before[signum] = signal.signal(signum, partial(_hosts, handler))
    return before
