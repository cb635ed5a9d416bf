"""Ctrl-C and SIGTERM in the command line: one clean stop, soon and for certain."""

from __future__ import annotations

import os
import signal
import sys
import threading
from types import FrameType

GRACE_S = 2.0
"""Time to unwind; whatever hangs then is left behind. Results are safe: files appear whole or not at all."""

_words = "stopped"


class Stopped(BaseException):
    """A signal asked this process to stop. No KeyboardInterrupt: others catch that and exit as they like."""

    def __init__(self, signum: int) -> None:
        super().__init__(signal.Signals(signum).name)
        self.exit_code = 128 + signum


def handle_signals() -> None:
    """Turn Ctrl-C and SIGTERM into :class:`Stopped`, raised in the main thread."""
    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, _stop)


def _stop(signum: int, frame: FrameType | None) -> None:
    for other in (signal.SIGINT, signal.SIGTERM):
        signal.signal(other, signal.SIG_IGN)  # a second Ctrl-C must not tear the clean-up apart
    timer = threading.Timer(GRACE_S, _leave, (128 + signum,))
    timer.daemon = True
    timer.start()
    raise Stopped(signum)


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
