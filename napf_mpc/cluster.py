"""Blocks of runs over the workers of a ``dask.distributed`` scheduler. The one home of distributed."""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from napf_mpc.errors import NapfError
from napf_mpc.own_parts import OwnParts
from napf_mpc.problem import Problem
from napf_mpc.provenance import differences, identity
from napf_mpc.words import shown_text
from napf_mpc.workers import DIED, HUNG, Lost, guarded

CONNECT_S = 8.0
"""Time [s] in which a scheduler must answer, and in which its first worker must be there."""
ALONE_S = 120.0
"""Time [s] after which a scheduler that has lost all workers is given up."""
FETCH_S = 60.0
"""Time [s] in which a worker must hand over what came of a block: it may hang after that, too."""
_KEPT = "finished blocks are kept: repeat the command to go on"


class Cluster:
    """Workers of a scheduler, as a :class:`napf_mpc.workers.Pool`.

    Parameters
    ----------
    client : distributed.Client
        Connected to the scheduler.
    name : str
        Of the option and the address, for messages.
    agree : callable
        Says in lines what of the campaign's origin is different where it is called.
    """

    def __init__(self, client: Any, name: str, agree: Callable[[], list[str]]) -> None:
        self._client = client
        self._name = name
        self._agree = agree
        self._task: Callable[[range], Any] | None = None
        self._held: dict[Future[Any], Any] = {}
        self._began: dict[Future[Any], float] = {}
        self._alone_since: float | None = None

    def flying(self, task: Callable[[range], Any]) -> Cluster:
        """Set what is done with a block."""
        self._task = partial(_on_worker, self._agree, task)
        return self

    def slots(self) -> int:
        """Workers that are there now: each flies one block at a time, however many threads it has.

        Raises
        ------
        NapfError
            If the scheduler is gone, or its last worker has been for :data:`ALONE_S`.
        """
        try:
            count = len(self._client.nthreads())
        except Exception as error:  # of the network, of the event loop, of a client that has closed itself
            raise self._gone() from error
        if count:
            self._alone_since = None
            return count
        self._alone_since = self._alone_since or time.monotonic()
        if time.monotonic() - self._alone_since > ALONE_S:
            raise NapfError(f"{self._name}: its last worker is gone; {_KEPT}")
        return 0

    def submit(self, block: range) -> Future[Any]:
        """Begin with a block."""
        held = self._client.submit(self._task, block, pure=False, retries=0)
        future: Future[Any] = Future()
        self._held[future], self._began[future] = held, time.monotonic()
        held.add_done_callback(lambda _: future.set_result(None))  # what came of it is asked for later
        return future

    def seconds(self, future: Future[Any]) -> float:
        """Time [s] since a block was handed over."""
        return time.monotonic() - self._began[future]

    def result(self, future: Future[Any]) -> Any:
        """What came of a block; the scheduler has tried several workers before it says that they died.

        A worker that does not hand it over in :data:`FETCH_S` is started anew.

        Raises
        ------
        NapfError
            If the scheduler is gone, or a worker that came later is not like this process.
        """
        from distributed import KilledWorker

        try:
            return self._held[future].result(timeout=FETCH_S)
        except TimeoutError:
            with contextlib.suppress(Exception):
                held = self._held[future]
                self._start_anew(held, self._client.who_has([held])[held.key])
            return HUNG
        except KilledWorker:
            return replace(DIED, retried=True)
        except CancelledError as error:
            raise self._gone() from error
        except (NapfError, MemoryError):
            raise
        except Exception as error:  # a worker that came later and cannot load the task
            return Lost("failed", " ".join(f"{type(error).__name__}: {error}".split())[:200])

    def release(self, future: Future[Any], *, usable: bool) -> None:
        """Forget a block; a worker that hangs with it is started anew, if it has a nanny that can do so."""
        held = self._held.pop(future)
        del self._began[future]
        if future.done():
            return
        with contextlib.suppress(Exception):
            where = [worker for worker, keys in self._client.processing().items() if held.key in keys]
            self._start_anew(held, where)

    def _start_anew(self, held: Any, workers: Sequence[str]) -> None:
        """Take a block back and start its workers anew, those that have a nanny."""
        held.cancel(force=True)
        self._client.restart_workers(list(workers), timeout=CONNECT_S, raise_for_error=False)

    def close(self) -> None:
        """Take back what is not finished; a block that a worker has begun is ended there and thrown away."""
        with contextlib.suppress(Exception):
            self._client.cancel(list(self._held.values()), force=True)
        self._held = {}

    def _gone(self) -> NapfError:
        return NapfError(f"{self._name}: the scheduler is gone; {_KEPT}")


@contextlib.contextmanager
def connected(
    address: str,
    origin: Mapping[str, Any],
    problem: Problem,
    data_folder: Path | None = None,
    own: OwnParts | None = None,
) -> Iterator[Cluster]:
    """Connect to a scheduler whose workers are all like this process.

    Parameters
    ----------
    address : str
        For example ``tcp://192.168.0.7:8786``.
    origin : mapping
        Of :func:`napf_mpc.provenance.identity`: what every worker must agree with.
    problem : Problem
        What is flown.
    data_folder : Path, optional
        Where data files lie, on every worker; None for each worker's own.
    own : OwnParts, optional
        Registered planners and solver among those that fly.

    Raises
    ------
    NapfError
        If distributed is not installed, nobody answers, there are no workers, or one of them lacks this
        package or a data file, or has another version of something that decides a result.
    """
    name = f"--cluster {shown_text(address, 120)}"
    try:
        from distributed import Client
    except ImportError as error:
        raise NapfError(f"{name}: needs the package distributed: pip install 'napf-mpc[cluster]'") from error
    folder = None if data_folder is None else Path(data_folder).resolve()
    agree = partial(differing, dict(origin), problem, folder, own)
    with _quiet(), contextlib.ExitStack() as stack:
        client = _client(Client, address, name)
        stack.callback(_leave, client)
        hint = "; modules of planners and solvers of your own must be installed there, too" if own else ""
        _check_workers(client, name, agree, hint)
        cluster = Cluster(client, name, agree)
        stack.callback(cluster.close)
        yield cluster


def _client(kind: Any, address: str, name: str) -> Any:
    """Connect, or say in time that nobody answers."""
    # Made in two steps, so that one that cannot connect can be closed, too: left to itself it complains.
    client = kind.__new__(kind)
    faults: list[Exception] = []

    def connect() -> None:
        try:
            client.__init__(address, timeout=CONNECT_S, set_as_default=False)
        except Exception as error:  # a malformed address, no such host, nobody there
            faults.append(error)

    # Their own time limit does not hold for somebody who listens there and never says a word.
    trial = threading.Thread(target=connect, daemon=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of other versions: we look at those ourselves
        trial.start()
        trial.join(CONNECT_S + 1.0)
    if trial.is_alive():
        faults.append(TimeoutError(f"whoever listens there is silent for {CONNECT_S:g} s"))
    if faults:
        _leave(client)
        reason = " ".join(str(faults[0]).split()) or type(faults[0]).__name__
        raise NapfError(f"{name}: no scheduler answers there: {shown_text(reason, 160)}") from faults[0]
    return client


def _check_workers(client: Any, name: str, agree: Callable[[], list[str]], hint: str) -> None:
    """Refuse workers that would not give the same bits."""
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
    except TimeoutError as error:
        raise NapfError(f"{name}: has no workers; start some there with: dask worker ADDRESS") from error
    try:
        answers = client.run(agree, on_error="return")
    except Exception as error:  # of the network, or of a planner that cannot be sent
        reason = shown_text(" ".join(str(error).split()), 160)
        raise NapfError(f"{name}: its workers could not be asked: {reason}") from error
    faults = []
    for worker, found in sorted(answers.items()):
        if isinstance(found, NapfError):
            faults.append(f"{name}: worker {worker}: {found}")
        elif isinstance(found, Exception):
            reason = shown_text(f"{type(found).__name__}: {found}", 160)
            faults.append(f"{name}: worker {worker} cannot load this version of napf-mpc: {reason}{hint}")
        elif found:
            faults.append(f"{name}: worker {worker} is not like this process: {'; '.join(found)}")
    if faults:
        raise NapfError("\n".join(faults))


def differing(
    origin: Mapping[str, Any],
    problem: Problem,
    data_folder: Path | None,
    own: OwnParts | None = None,
) -> list[str]:
    """Lines on what of a campaign's origin is different in this process: versions, code, data files.

    Raises
    ------
    DataError
        If a data file is missing here.
    """
    ours = identity(problem, origin["problem"], origin["planners"], origin["seed"], data_folder)
    for key, sources in ({} if own is None else own.digests()).items():
        # What travels whole has no source to be read here.
        read = {name: digest for name, digest in sources.items() if digest != "unknown"}
        ours[key] = origin.get(key, {}) | read
    compared = {key: origin.get(key, {}) for key in ours}
    return differences(json.loads(json.dumps(ours)), json.loads(json.dumps(compared)))


_one_at_a_time = threading.Lock()


def _on_worker(agree: Callable[[], list[str]], task: Callable[[range], Any], block: range) -> Any:
    """Fly a block, in a process that may have several threads for that."""
    with _one_at_a_time:
        if different := agree():
            from distributed import get_worker

            raise NapfError(
                f"worker {get_worker().address} is not like this process: {'; '.join(different)}; {_KEPT}"
            )
        return guarded(task, block)


def _leave(client: Any) -> None:
    with contextlib.suppress(Exception):
        client.close(timeout=1.0)
    client.status = "closed"  # whatever did not end in time: its finaliser would wait for it


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Leave it to our own messages to say what is wrong: theirs are long, and come from other threads."""
    names = [name for name in logging.root.manager.loggerDict if name.startswith(("distributed", "tornado"))]
    loggers = [logger for name in names if not (logger := logging.getLogger(name)).disabled]
    try:
        for logger in loggers:
            logger.disabled = True
        yield
    finally:
        for logger in loggers:
            logger.disabled = False
