"""Ctrl-C and SIGTERM in the command line: one clean stop, soon and for certain."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

GRACE_S = 2.5
"""Time to unwind; whatever hangs then is left behind. Results are safe: files appear whole or not at all."""

_words = "stopped"
_asked: int | None = None


class Stopped(BaseException):
    """A signal asked this process to stop. No KeyboardInterrupt: others catch that and exit as they like."""


def run(command: Callable[[], int]) -> NoReturn:
    """Run a command and leave with its exit code, or with 130 or 143 if Ctrl-C or SIGTERM came meanwhile.

    The signal raises :class:`Stopped` in the main thread, wherever that is. Code that is hit in an awkward
    place may swallow it or make another error of it, so what counts is that the signal came.
    """
    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, _stop)
    sys.unraisablehook = _tell_unraisable
    code = 0
    try:
        code = command()
    except BaseException:
        if _asked is None:
            raise
    if _asked is not None:
        say_stopped()
        code = 128 + _asked
    sys.exit(code)


def _stop(signum: int, frame: FrameType | None) -> None:
    global _asked
    _asked = signum
    for other in (signal.SIGINT, signal.SIGTERM):
        signal.signal(other, signal.SIG_IGN)  # a second Ctrl-C must not tear the clean-up apart
    timer = threading.Timer(GRACE_S, _leave, (128 + signum,))
    timer.daemon = True
    timer.start()
    raise Stopped(signal.Signals(signum).name)


def raise_if_asked() -> None:
    """Raise :class:`Stopped` if a signal came and what it raised was swallowed, as finalisers do."""
    if _asked is not None:
        raise Stopped(signal.Signals(_asked).name)


def _tell_unraisable(unraisable: UnraisableHookArgs) -> None:
    if not isinstance(unraisable.exc_value, Stopped):
        sys.__unraisablehook__(unraisable)


def _leave(exit_code: int) -> None:
    if sys.stderr.isatty():
        sys.stderr.write("\x1b[?25h")  # the cursor, that a progress bar may have hidden
    say_stopped()
    os._exit(exit_code)


def when_stopped(words: str) -> None:
    """Set the line that a stop ends with."""
    global _words
    _words = words


def say_stopped() -> None:
    """Print that line."""
    print(_words, file=sys.stderr, flush=True)
