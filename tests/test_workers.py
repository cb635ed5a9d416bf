"""Blocks over processes: all of them once, errors as they are, and a dead worker is no disaster."""

import os
import signal
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from napf_mpc.errors import NapfError, SceneError
from napf_mpc.workers import MAX_DEATHS, in_workers

BLOCKS = [range(first, first + 3) for first in range(0, 30, 3)]


def total(block: range) -> tuple[int, int]:
    return sum(block), os.getpid()


def fail(block: range) -> int:
    if block.start == 6:
        raise SceneError("run 7: no room")
    return 0


def die(folder: Path, times: int, block: range) -> int:
    """Kill its own process in one block, so many times."""
    if block.start == 12:
        for i in range(times):
            mark = folder / f"death{i}"
            if not mark.exists():
                mark.touch()
                os.kill(os.getpid(), signal.SIGKILL)
    return sum(block)


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
    with pytest.raises(SceneError, match="run 7: no room"):
        list(in_workers(fail, BLOCKS, workers))


@pytest.mark.skipif(sys.platform == "win32", reason="kill -9 is POSIX")
def test_a_worker_that_dies_costs_its_block_a_second_try(tmp_path: Path) -> None:
    done = dict(in_workers(partial(die, tmp_path, MAX_DEATHS - 1), BLOCKS, 2))
    assert done == {block: sum(block) for block in BLOCKS}
    assert len(list(tmp_path.iterdir())) == MAX_DEATHS - 1


@pytest.mark.skipif(sys.platform == "win32", reason="kill -9 is POSIX")
def test_a_block_that_kills_every_worker_is_given_up_with_its_place(tmp_path: Path) -> None:
    with pytest.raises(NapfError, match=f"workers died {MAX_DEATHS} times in a row at run 12 or after it"):
        list(in_workers(partial(die, tmp_path, 99), BLOCKS, 2))


@pytest.mark.skipif(sys.platform == "win32", reason="process ids are looked up as POSIX does")
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
