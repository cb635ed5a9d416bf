"""Blocks of runs over processes of this machine: none outlives us, and one that dies costs only its block."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from napf_mpc.errors import NapfError

T = TypeVar("T")

MAX_DEATHS = 3
"""Times in a row that workers may die before any block is finished."""
_WATCH_S = 0.5


def in_workers(
    task: Callable[[range], T], blocks: Sequence[range], workers: int
) -> Generator[tuple[range, T], None, None]:
    """Do a task for every block, over several processes if that is wanted; blocks come as they finish.

    Workers do not see Ctrl-C: the terminal sends it to all, but only this process knows what to keep. They
    end with this process, whichever way it ends. Close the iterator to stop them.

    Parameters
    ----------
    task : callable
        Takes a block; it and its results can be sent to another process.
    blocks : sequence of range
        What to do.
    workers : int
        Processes, 1 for this one.

    Yields
    ------
    tuple of range and result
        In no fixed order.

    Raises
    ------
    NapfError
        If the task does, or if workers die again and again.
    """
    if workers == 1 or len(blocks) <= 1:
        for block in blocks:
            yield block, task(block)
        return
    left = dict.fromkeys(blocks)
    deaths = 0
    while left:
        try:
            with contextlib.closing(_in_pool(task, list(left), workers)) as pool:
                for block, result in pool:
                    del left[block]
                    deaths = 0
                    yield block, result
        except BrokenProcessPool as error:
            deaths += 1
            if deaths == MAX_DEATHS:
                first = next(iter(left))
                raise NapfError(
                    f"workers died {deaths} times in a row at run {first.start} or after it (killed, or out "
                    "of memory?); finished blocks are kept: repeat the command with fewer --workers"
                ) from error


def _in_pool(
    task: Callable[[range], T], blocks: list[range], workers: int
) -> Generator[tuple[range, T], None, None]:
    import joblib  # only here: it costs start-up time that a single process need not pay

    parallel = joblib.Parallel(
        n_jobs=max(2, min(workers, len(blocks))),  # with 1, joblib would fly a last block in this process
        backend="loky",
        return_as="generator_unordered",
        batch_size=1,
        max_nbytes=None,
    )
    with _without_interrupts():
        results = parallel(joblib.delayed(_numbered)(task, block, os.getpid()) for block in blocks)
    try:
        for result in results:  # noqa: UP028 - "yield from" would close it by itself, with warnings
            yield result
    finally:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that results are thrown away: it is what a stop is for
            results.close()


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """Block Ctrl-C while processes start: they inherit that; one that comes meanwhile is ours afterwards."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    # These helper processes of theirs unblock signals when they start, so they have to run by now.
    from multiprocessing import resource_tracker

    from joblib.externals.loky.backend import resource_tracker as loky_resource_tracker

    resource_tracker.ensure_running()
    loky_resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _numbered(task: Callable[[range], T], block: range, parent: int) -> tuple[range, T]:
    _end_with(parent)
    return block, task(block)


_watched: set[int] = set()


def _end_with(parent: int) -> None:
    """End this worker soon after the process that started it, even one that was killed."""
    if parent not in _watched:
        _watched.add(parent)
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_WATCH_S)
    os._exit(1)
