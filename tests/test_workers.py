"""Blocks over processes: all of them once, errors as they are, and a dead worker is no disaster."""

import os
import re
import signal
import sys
import time
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from napf_mpc.errors import NapfError, ProblemError
from napf_mpc.workers import DIED, HUNG, MAX_LOST, Lost, _Processes, in_workers

BLOCKS = [range(first, first + 3) for first in range(0, 30, 3)]


def total(block: range) -> tuple[int, int]:
    return sum(block), os.getpid()


def fail(block: range) -> int:
    if block.start == 6:
        raise ProblemError("run 7", ["no room", "no air"])
    return 0


def strike(folder: Path, times: int, how: str, block: range) -> int:
    """Fail in one block, so many times: be killed, raise what nobody expects, hang or stand still."""
    if block.start == 12:
        for i in range(times):
            mark = folder / f"strike{i}"
            if not mark.exists():
                mark.touch()
                if how == "error":
                    raise ZeroDivisionError("nothing\nto divide by")
                if how == "hang":
                    time.sleep(600.0)
                os.kill(os.getpid(), {"die": signal.SIGKILL, "stop": signal.SIGSTOP}[how])
                time.sleep(600.0)
    return sum(block)


def always(block: range) -> int:
    raise ZeroDivisionError


def wait(folder: Path, block: range) -> int:
    (folder / f"{os.getpid()}").touch()
    time.sleep(60.0 if block.start else 0.0)
    return 0


@pytest.mark.parametrize("workers", [1, 2])
def test_every_block_is_done_once(workers: int) -> None:
    done = dict(in_workers(total, BLOCKS, workers))
    assert {block: result for block, (result, _) in done.items()} == {block: sum(block) for block in BLOCKS}
    ours = [pid == os.getpid() for _, pid in done.values()]
    assert all(ours) if workers == 1 else not any(ours)


def test_one_block_is_not_worth_a_process() -> None:
    ((_, (_, pid)),) = in_workers(total, BLOCKS[:1], 2)
    assert pid == os.getpid()
    assert list(in_workers(total, [], 2)) == []


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_comes_as_it_was_raised(workers: int) -> None:
    with pytest.raises(ProblemError, match="run 7: no room\nrun 7: no air") as caught:
        list(in_workers(fail, BLOCKS, workers))
    assert caught.value.problems == ["no room", "no air"]


@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX")
@pytest.mark.parametrize(("how", "workers"), [("die", 2), ("error", 1), ("error", 2), ("hang", 2)])
def test_a_failure_costs_its_block_a_second_try(how: str, workers: int, tmp_path: Path) -> None:
    done = dict(in_workers(partial(strike, tmp_path, 1, how), BLOCKS, workers, limit_s=10.0))
    assert done == {block: sum(block) for block in BLOCKS}
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX")
@pytest.mark.parametrize(
    ("how", "workers", "lost"), [("die", 2, DIED), ("error", 1, None), ("error", 2, None), ("stop", 2, HUNG)]
)
def test_a_block_that_fails_twice_is_lost_and_the_rest_goes_on(
    how: str, workers: int, lost: Lost | None, tmp_path: Path
) -> None:
    done = dict(in_workers(partial(strike, tmp_path, 99, how), BLOCKS, workers, limit_s=10.0))
    assert len(list(tmp_path.iterdir())) == 2
    found = done.pop(range(12, 15))
    assert done == {block: sum(block) for block in BLOCKS if block.start != 12}
    if lost is None:
        assert isinstance(found, Lost)
        assert found.outcome == "failed"
        assert re.fullmatch(r"ZeroDivisionError: nothing to divide by \(test_workers\.py:\d+\)", found.reason)
    else:
        assert found == lost


@pytest.mark.parametrize("workers", [1, 2])
def test_when_block_after_block_is_lost_nothing_more_is_tried(workers: int) -> None:
    blocks = [range(first, first + 1) for first in range(3 * MAX_LOST)]
    flown = in_workers(always, blocks, workers)
    for _ in range(MAX_LOST - 1):
        assert isinstance(next(flown)[1], Lost)
    with pytest.raises(NapfError, match=f"{MAX_LOST} blocks in a row were lost, .*: ZeroDivisionError"):
        next(flown)


@pytest.mark.skipif(sys.platform == "win32", reason="process ids are looked up as POSIX does")
@pytest.mark.parametrize(
    ("said", "cause"),
    [
        ("A result has failed to un-serialize. Please", "EOFError"),
        ("A task has failed to un-serialize. Please", "MemoryError"),
        ("A worker process managed by the executor was unexpectedly terminated.", None),
    ],
)
def test_a_worker_that_dies_half_way_is_dead_and_its_task_is_not_to_blame(
    said: str, cause: str | None
) -> None:
    """Killed while it writes its result, it leaves half of it; with memory short it cannot read on."""
    error = BrokenProcessPool(said)
    error.__cause__ = None if cause is None else Exception(f'\n"""\nTraceback\n{cause}\n"""')
    future: Future[Any] = Future()
    future.set_exception(error)
    assert _Processes(str, 1).result(future) == DIED


def test_closing_ends_the_workers(tmp_path: Path) -> None:
    results = in_workers(partial(wait, tmp_path), BLOCKS, 2)
    next(results)
    before = time.monotonic()
    results.close()
    assert time.monotonic() - before < 3.0
    pids = [int(path.name) for path in tmp_path.iterdir()]
    assert pids
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
