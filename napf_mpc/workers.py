"""Blocks of runs over processes: none outlives us; one that dies or hangs costs its block one retry."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar

from napf_mpc.errors import NapfError
from napf_mpc.words import shown_text

T = TypeVar("T")

MAX_LOST = 10
"""Blocks in a row that may be lost before flying on makes no sense."""
HUNG_FACTOR = 20.0
"""A block hangs that takes this many times as long as the slowest that has been finished, ..."""
HUNG_LEAST_S = 1800.0
"""... but no less than this, which covers compilation on a busy machine."""
HUNG_FIRST_S = 21_600.0
"""While none is finished yet."""
_UNREAD = "A task has failed to un-serialize"
"""What loky says of a worker that could not read its task; one that died writes nothing, or half a result."""
_LOOK_S = 1.0
_WATCH_S = 0.5
_ONE_THREAD = dict.fromkeys(
    (
        "BLIS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "NUMBA_NUM_THREADS",
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
    ),
    "1",
)


@dataclass(frozen=True)
class Lost:
    """Why a block could not be flown, twice."""

    outcome: Literal["failed", "timeout"]
    """One of :class:`napf_mpc.evaluate.Outcome`."""
    reason: str
    """In few words, for the column ``reason`` of its runs."""
    retried: bool = False
    """Whether it was tried again where it was flown, so that nobody else has to."""


DIED = Lost("failed", "worker died")
HUNG = Lost("timeout", "worker hung")


class Pool(Protocol):
    """Where blocks are flown: processes of this machine, or workers of a cluster."""

    def slots(self) -> int:
        """Blocks that can be flown at a time, now."""
        ...

    def submit(self, block: range) -> Future[Any]:
        """Begin with a block, under :func:`guarded`."""
        ...

    def seconds(self, future: Future[Any]) -> float:
        """Time [s] that a block has had."""
        ...

    def result(self, future: Future[Any]) -> Any:
        """What came of a block that has ended: its result, or how it was lost.

        Raises
        ------
        NapfError
            If it is none of the block's fault.
        """
        ...

    def release(self, future: Future[Any], *, usable: bool) -> None:
        """Take back what flew a block, or end it if it is dead or hangs."""
        ...

    def close(self) -> None:
        """End everything."""
        ...


def guarded(task: Callable[[range], T], block: range) -> T | Lost:
    """Do a task in a worker; an error that is no message to the user is the loss of its block."""
    try:
        return task(block)
    except (NapfError, MemoryError):
        raise
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        words = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        return Lost("failed", f"{words} ({Path(last.filename).name}:{last.lineno})")


def in_workers(
    task: Callable[[range], T], blocks: Sequence[range], workers: int, limit_s: float | None = None
) -> Generator[tuple[range, T | Lost], None, None]:
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
    limit_s : float, optional
        Time [s] after which a worker counts as hung; see :func:`in_pool`. A block in this process has none.

    Yields
    ------
    tuple of range and result
        In no fixed order; :class:`Lost` for a block that failed twice.

    Raises
    ------
    NapfError
        If the task does, or if block after block is lost.
    """
    if workers == 1 or len(blocks) <= 1:
        yield from _in_this_process(task, blocks)
        return
    with contextlib.closing(_Processes(task, min(workers, len(blocks)))) as pool:
        yield from in_pool(pool, blocks, limit_s)


def _in_this_process(
    task: Callable[[range], T], blocks: Sequence[range]
) -> Generator[tuple[range, T | Lost], None, None]:
    count = _Losses()
    for block in blocks:
        result = guarded(task, block)
        if isinstance(result, Lost):
            result = guarded(task, block)
        count.add(block, result)
        yield block, result


@dataclass
class _Losses:
    """Blocks lost in a row."""

    in_a_row: int = 0

    def add(self, block: range, result: object) -> None:
        self.in_a_row = self.in_a_row + 1 if isinstance(result, Lost) else 0
        if isinstance(result, Lost) and self.in_a_row == MAX_LOST:
            raise NapfError(
                f"{MAX_LOST} blocks in a row were lost, the last one at run {block.start}: {result.reason}; "
                "finished blocks are kept: repeat the command, with fewer --workers if memory ran out"
            )


def in_pool(
    pool: Pool, blocks: Sequence[range], limit_s: float | None = None
) -> Generator[tuple[range, Any], None, None]:
    """Do all blocks in a pool, each lost one a second time.

    Parameters
    ----------
    pool : Pool
        Where.
    blocks : sequence of range
        What.
    limit_s : float, optional
        Time [s] that a block may take; by default :data:`HUNG_FACTOR` times the slowest so far and no less
        than :data:`HUNG_LEAST_S`.

    Yields
    ------
    tuple of range and result
        As in :func:`in_workers`.
    """
    left = deque(blocks)
    lost: set[range] = set()
    flying: dict[Future[Any], range] = {}
    slowest_s: float | None = None
    count = _Losses()

    def begin() -> None:
        for _ in range(min(len(left), pool.slots() - len(flying))):
            block = left.popleft()
            flying[pool.submit(block)] = block

    begin()
    while left or flying:
        done = wait(flying, timeout=_LOOK_S, return_when=FIRST_COMPLETED).done
        if not flying:
            time.sleep(_LOOK_S)  # a cluster without workers, for now
        took_s = {future: pool.seconds(future) for future in flying}
        limit = _limit_s(slowest_s) if limit_s is None else limit_s
        hung = {future for future in flying if future not in done and took_s[future] > limit}
        ended: list[tuple[range, Any]] = []
        for future in [*done, *hung]:
            block = flying.pop(future)
            result = HUNG if future in hung else pool.result(future)
            pool.release(future, usable=result != HUNG and result != DIED)
            if not isinstance(result, Lost):
                slowest_s = max(slowest_s or 0.0, took_s[future])
            elif block not in lost and not result.retried:
                lost.add(block)
                left.appendleft(block)
                continue
            ended.append((block, result))
        begin()  # whoever is free, before results are looked at, which may take a while
        for block, result in ended:
            count.add(block, result)
            yield block, result


def _limit_s(slowest_s: float | None) -> float:
    return HUNG_FIRST_S if slowest_s is None else max(HUNG_LEAST_S, HUNG_FACTOR * slowest_s)


class _Processes:
    """Worker processes, each a pool of one: a death is then the fault of one block and costs no other."""

    def __init__(self, task: Callable[[range], Any], count: int) -> None:
        self._task = partial(guarded, task)
        self._count = count
        self._all: set[_Worker] = set()
        self._free: list[_Worker] = []
        self._busy: dict[Future[Any], _Worker] = {}
        _room_for_pipes(count)

    def slots(self) -> int:
        return self._count

    def submit(self, block: range) -> Future[Any]:
        with _without_interrupts():
            while self._free:
                worker = self._free.pop()
                try:
                    return self._begun(worker, block)
                except BrokenProcessPool:  # it died while it had nothing to do
                    self._end(worker)
            worker = _Worker(self._task)
            self._all.add(worker)
            return self._begun(worker, block)

    def _begun(self, worker: _Worker, block: range) -> Future[Any]:
        future = worker.submit(block)
        self._busy[future] = worker
        return future

    def seconds(self, future: Future[Any]) -> float:
        return self._busy[future].seconds()

    def result(self, future: Future[Any]) -> Any:
        try:
            return future.result()
        except (NapfError, MemoryError):
            raise
        except BrokenProcessPool as error:
            unread = str(error).startswith(_UNREAD) and "MemoryError" not in str(error.__cause__)
            if not unread or error.__cause__ is None:
                return DIED
            raise _not_given(error.__cause__) from error
        except Exception as error:  # its task could not be written
            raise _not_given(error.__cause__ or error) from error

    def release(self, future: Future[Any], *, usable: bool) -> None:
        worker = self._busy.pop(future)
        if usable:
            self._free.append(worker)
        else:
            self._end(worker)

    def _end(self, worker: _Worker) -> None:
        worker.end()
        self._all.discard(worker)

    def close(self) -> None:
        if self._all:
            with ThreadPoolExecutor(min(32, len(self._all))) as ends:  # all at once: a stop must be prompt
                for worker in self._all:
                    ends.submit(worker.end)


def _not_given(cause: BaseException) -> NapfError:
    reason = shown_text(str(cause).strip().strip('"').strip().splitlines()[-1], 200)
    return NapfError(
        f"a worker cannot be given its task: {reason}; define planners and solvers of your own in a module "
        "that workers find (PYTHONPATH, or an installed package), or fly with --workers 1"
    )


class _Worker:
    """A process that does a task for one block after the other."""

    def __init__(self, task: Callable[[range], Any]) -> None:
        from joblib.externals.loky import ProcessPoolExecutor  # only here: it costs start-up time

        self._pool = ProcessPoolExecutor(
            max_workers=1, initializer=_end_with, initargs=(os.getpid(),), env=_ONE_THREAD
        )
        self._task = task
        self._block: Future[Any] | None = None
        self._began = self._started = time.monotonic()
        self._up: float | None = None

    def submit(self, block: range) -> Future[Any]:
        if self._block is None:
            # Reading the task loads everything that it needs.
            self._pool.submit(_load, self._task).add_done_callback(self._is_up)
        self._began = time.monotonic()
        self._block = self._pool.submit(self._task, block)
        return self._block

    def _is_up(self, _: Future[Any]) -> None:
        self._up = time.monotonic()

    def seconds(self) -> float:
        """Time [s] that the block has had; starting takes none of it, unless it does not end."""
        now = time.monotonic()
        if self._up is not None:
            return now - max(self._began, self._up)
        return now - self._started if now - self._started > HUNG_LEAST_S else 0.0

    def end(self) -> None:
        """Kill the process."""
        deadline = time.monotonic() + 0.5
        # Between being taken and being sent to the process a block makes this pool stumble over its own end.
        while (
            self._block and not (self._block.running() or self._block.done()) and time.monotonic() < deadline
        ):
            time.sleep(0.001)
        self._pool.shutdown(wait=True, kill_workers=True)


def _load(task: Callable[[range], Any]) -> None:
    """Do nothing with a task but read it."""


def _room_for_pipes(workers: int) -> None:
    """Let this process have the files open that talking to so many workers takes."""
    if sys.platform == "win32":
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = 256 + 16 * workers
    if soft != resource.RLIM_INFINITY and soft < needed:
        most = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, most), hard))


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """Block Ctrl-C while processes start: they inherit that; one that comes meanwhile is ours afterwards."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    # These helper processes of theirs unblock signals when they start, so they have to run by now.
    from multiprocessing import resource_tracker

    from joblib.externals.loky.backend import resource_tracker as loky_resource_tracker

    with _set("PYTHONWARNINGS", "ignore:resource_tracker:UserWarning"):
        # A stop may leave something for them to tidy up, which is no news to whoever stopped.
        resource_tracker.ensure_running()
        loky_resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _set(name: str, value: str) -> Iterator[None]:
    """Set a variable of the environment for processes that start meanwhile."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def _end_with(parent: int) -> None:
    """End this worker soon after the process that started it, even one that was killed."""
    if sys.platform == "linux":
        import ctypes

        # The system sees to it, also when this worker hangs where no thread of it can run.
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_WATCH_S)
    os._exit(1)
