"""Campaigns on a dask cluster: the same bits, one line for whatever is wrong with it, nothing lost."""

import contextlib
import hashlib
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import types
from collections.abc import Iterator
from concurrent.futures import wait
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from campaign_torture import PROBLEM, START, finished

from napf_mpc import cluster as cluster_module
from napf_mpc import store
from napf_mpc.campaign import run_campaign
from napf_mpc.cli import run_command
from napf_mpc.cluster import connected, differing
from napf_mpc.errors import NapfError
from napf_mpc.own_parts import OwnParts
from napf_mpc.planners import registry
from napf_mpc.planners.potential_field import ApfPlanner
from napf_mpc.problem import Problem
from napf_mpc.problem_file import load_problem
from napf_mpc.provenance import identity
from napf_mpc.workers import HUNG, Lost, in_pool

NEEDED = "needs the extra: pip install 'napf-mpc[cluster]'"
distributed = pytest.importorskip("distributed", reason=NEEDED)
dask_config = pytest.importorskip("dask.config", reason=NEEDED)

BRIEF: dict[str, Any] = {
    "mission": {"length_m": 1.0, "initial_velocities_mps": [[2.0, 0.0, 0.0]] * 4},
    "world.count": 4,
    "world.along_range_m": [0.0, 12.0],
    "simulation.time_limit_s": 2.0,
    "simulation.controller_rate_hz": 25.0,
    "planner.rate_hz": 5.0,
    "navigation.rate_hz": 5.0,
}
RUNS = 20
WAIT_S = 300.0


def brief() -> Problem:
    return load_problem("table1_8", BRIEF)


def origin() -> dict[str, Any]:
    return identity(brief(), "problem", ["apf"], 7)


def digest(out: Path) -> str:
    return hashlib.sha256((out / "runs.parquet").read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> str:
    out = tmp_path_factory.mktemp("undisturbed")
    run_campaign(brief(), ["apf"], RUNS, 7, out)
    return digest(out)


def fly(address: str, out: Path, **options: Any) -> str:
    run_campaign(brief(), ["apf"], RUNS, 7, out, cluster=address, **options)
    return digest(out)


@pytest.fixture(scope="module")
def local() -> Iterator[str]:
    """Address of a scheduler in this process, with two worker processes."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs="CRITICAL"
    ) as running:
        yield running.scheduler_address


@pytest.mark.parametrize("block_runs", [3, 7])
def test_a_local_cluster_changes_no_bit(
    block_runs: int, local: str, undisturbed: str, tmp_path: Path
) -> None:
    assert fly(local, tmp_path, block_runs=block_runs) == undisturbed


def test_a_campaign_goes_on_from_one_engine_to_another(local: str, undisturbed: str, tmp_path: Path) -> None:
    run_campaign(brief(), ["apf"], 8, 7, tmp_path, block_runs=3)
    assert fly(local, tmp_path, block_runs=5) == undisturbed


def test_a_planner_of_ones_own_flies_there_too(
    local: str, undisturbed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Inside(ApfPlanner):
        """Workers cannot import it: it travels whole."""

    monkeypatch.setattr(registry, "_OWN", {"mine": Inside})
    run_campaign(brief(), ["apf", "mine"], 4, 7, tmp_path, cluster=local, block_runs=2)
    rows = store.read_table(tmp_path / "runs.parquet")
    effort = [rows["control_effort"][rows["planner"] == name] for name in ("apf", "mine")]
    np.testing.assert_array_equal(*effort)


def test_a_planner_that_the_workers_cannot_have_is_named(
    local: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module: Any = types.ModuleType("nowhere_to_be_found")
    module.Mine = type("Mine", (ApfPlanner,), {"__module__": module.__name__})
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(registry, "_OWN", {"mine": module.Mine})
    told = (
        r"worker tcp://\S+ cannot load .*nowhere_to_be_found.*; modules of planners and solvers of your own"
    )
    with pytest.raises(NapfError, match=told):
        run_campaign(brief(), ["mine"], 2, 7, tmp_path / "out", cluster=local)
    lock = threading.Lock()
    monkeypatch.setattr(registry, "_OWN", {"mine": lambda problem: ApfPlanner(problem) if lock else None})
    with pytest.raises(NapfError, match=r"its workers could not be asked: .*(pickle|serialize)"):
        run_campaign(brief(), ["mine"], 2, 7, tmp_path / "out", cluster=local)
    assert not (tmp_path / "out").exists()


def test_another_source_of_a_planner_is_a_difference() -> None:
    held = origin() | {"planners": ["mine"], "own_planners": {"mine": "0123456789abcdef"}}
    (line,) = differing(held, brief(), None, OwnParts({"mine": ApfPlanner}, None))
    assert re.fullmatch("own_planners.mine = [0-9a-f]{16}, not 0123456789abcdef", line)
    # One that travelled whole has no source to be read there.
    whole = OwnParts({"mine": eval("lambda problem: None", {"__name__": "x"})}, None)
    assert differing(held, brief(), None, whole) == []


def die(block: range) -> int:
    """Kill the worker in one block."""
    if block.start == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return sum(block)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX")
def test_a_block_that_kills_its_workers_is_lost_and_the_rest_goes_on() -> None:
    blocks = [range(first, first + 3) for first in range(0, 12, 3)]
    with (
        dask_config.set({"distributed.scheduler.allowed-failures": 0}),
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, dashboard_address=":0", silence_logs="CRITICAL"
        ) as running,
        connected(running.scheduler_address, origin(), brief()) as cluster,
    ):
        done = dict(in_pool(cluster.flying(die), blocks))
    assert done.pop(range(3, 6)) == Lost("failed", "worker died", retried=True)
    assert done == {block: sum(block) for block in blocks if block.start != 3}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX")
def test_a_stop_keeps_blocks_and_leaves_the_cluster_as_it_is(local: str, tmp_path: Path) -> None:
    (tmp_path / "problem.toml").write_text(PROBLEM)
    out = tmp_path / "out"
    words = ["montecarlo", str(tmp_path / "problem.toml"), "--planner", "apf", "--runs", "9600"]
    words += ["--out", str(out), "--cluster", local, "--quiet"]
    process = subprocess.Popen(
        [sys.executable, "-c", START, *words], stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        deadline = time.monotonic() + WAIT_S
        while not finished(out) and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)
        _, stderr = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    assert re.fullmatch(r"stopped: \d+ of 9600 runs are kept in .*; repeat the command to go on\n", stderr)
    assert finished(out)
    with distributed.Client(local, set_as_default=False) as client:
        assert len(client.nthreads()) == 2


# ----------------------------------------------------------------------------- processes of their own


@contextlib.contextmanager
def dask(*words: str, folder: Path | None = None) -> Iterator[subprocess.Popen[str]]:
    """Run a dask command in a group of its own, which ends with the block."""
    process = subprocess.Popen(
        [sys.executable, "-m", "distributed.cli." + words[0], *words[1:]],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def scheduler() -> Iterator[tuple[str, subprocess.Popen[str]]]:
    address = f"tcp://127.0.0.1:{free_port()}"
    words = ("dask_scheduler", "--host", address, "--no-dashboard")
    with dask(*words) as process:
        deadline = time.monotonic() + WAIT_S
        while time.monotonic() < deadline:
            with contextlib.suppress(OSError), socket.create_connection(address_of(address), 1.0):
                break
            time.sleep(0.1)
        yield address, process


def address_of(address: str) -> tuple[str, int]:
    host, _, port = address.removeprefix("tcp://").partition(":")
    return host, int(port)


def worker(
    address: str, folder: Path | None = None, nanny: bool = True
) -> contextlib.AbstractContextManager[subprocess.Popen[str]]:
    words = [
        "dask_worker",
        address,
        "--nthreads",
        "1",
        "--no-dashboard",
        "--nanny" if nanny else "--no-nanny",
    ]
    return dask(*words, folder=folder)


def wait_for_workers(address: str, count: int) -> None:
    with distributed.Client(address, set_as_default=False) as client:
        client.wait_for_workers(count, timeout=WAIT_S)


@pytest.mark.slow
def test_schedulers_and_workers_of_their_own_change_no_bit_and_may_come_and_go(
    undisturbed: str, tmp_path: Path
) -> None:
    with scheduler() as (address, _), worker(address, nanny=False) as first, worker(address, nanny=False):
        wait_for_workers(address, 2)
        killed: list[int] = []

        def kill(done: int) -> None:
            if done >= 4 and not killed:
                killed.append(first.pid)
                first.kill()

        told: list[str] = []
        assert fly(address, tmp_path / "a", block_runs=2, progress=kill, warn=told.append) == undisturbed
        assert (killed, told) == ([first.pid], [])


@pytest.mark.slow
def test_a_scheduler_that_dies_loses_nothing(undisturbed: str, tmp_path: Path) -> None:
    with scheduler() as (address, process), worker(address, nanny=False):
        wait_for_workers(address, 1)

        def kill(done: int) -> None:
            if done >= 4:
                process.kill()

        with pytest.raises(NapfError, match=f"--cluster {address}: the scheduler is gone; finished blocks"):
            fly(address, tmp_path, block_runs=2, progress=kill)
    assert len(list((tmp_path / "blocks").glob("rows_*"))) >= 2
    run_campaign(brief(), ["apf"], RUNS, 7, tmp_path)
    assert digest(tmp_path) == undisturbed


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX")
def test_a_worker_that_hangs_is_started_anew_and_its_block_flown_again(
    undisturbed: str, tmp_path: Path
) -> None:
    with scheduler() as (address, _), worker(address):
        wait_for_workers(address, 1)
        stopped: list[int] = []

        def stop(done: int) -> None:
            if done >= 4 and not stopped:
                with distributed.Client(address, set_as_default=False) as client:
                    (pid,) = client.run(os.getpid).values()
                stopped.append(pid)
                os.kill(pid, signal.SIGSTOP)

        told: list[str] = []
        assert (
            fly(address, tmp_path, block_runs=2, block_limit_s=20.0, progress=stop, warn=told.append)
            == undisturbed
        )
        assert len(stopped) == 1
        assert told == []


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX")
def test_a_worker_that_hangs_with_a_finished_block_is_started_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """It has told the scheduler that it is done, and then hands nothing over."""
    monkeypatch.setattr(cluster_module, "FETCH_S", 2.0)
    with (
        scheduler() as (address, _),
        worker(address),
        connected(address, origin(), brief()) as cluster,
    ):
        cluster.flying(lambda block: os.getpid())  # it travels whole: workers cannot import tests
        first, second = cluster.submit(range(1)), cluster.submit(range(1, 2))
        wait([first, second], timeout=WAIT_S)
        stopped = cluster.result(first)
        os.kill(stopped, signal.SIGSTOP)
        began = time.monotonic()
        assert cluster.result(second) == HUNG
        assert time.monotonic() - began < 30.0
        cluster.release(second, usable=False)
        while not cluster.slots() and time.monotonic() - began < WAIT_S:
            time.sleep(0.1)
        third = cluster.submit(range(2, 3))
        wait([third], timeout=WAIT_S)
        assert cluster.result(third) not in (stopped, HUNG)


# ---------------------------------------------------------------------------- what is wrong with a cluster


def complaint(capsys: pytest.CaptureFixture[str], address: str, out: Path) -> str:
    """Give the one line that a campaign there ends with."""
    words = ["montecarlo", "table1_8", "--planner", "apf", "--runs", "2", "--out", str(out)]
    assert run_command([*words, "--cluster", address]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith(f"error: --cluster {address}: ")
    assert said.err.count("\n") == 1
    assert not out.exists()
    return said.err


@pytest.mark.parametrize(
    "address", ["nonsense", "tcp://", "tcp://127.0.0.1:notaport", "http://127.0.0.1:1", ""]
)
def test_an_address_that_is_none_is_one_line(
    address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "no scheduler answers there: " in complaint(capsys, address, tmp_path / "out")


@pytest.mark.parametrize("listens", [False, True])
def test_an_address_where_nobody_answers_is_one_line(
    listens: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster_module, "CONNECT_S", 2.0)
    with socket.socket() as somebody:
        somebody.bind(("127.0.0.1", 0))
        if listens:
            somebody.listen()  # and never says a word
        address = f"tcp://127.0.0.1:{somebody.getsockname()[1]}"
        assert "no scheduler answers there: " in complaint(capsys, address, tmp_path / "out")


def test_a_scheduler_without_workers_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster_module, "CONNECT_S", 3.0)
    with distributed.LocalCluster(n_workers=0, dashboard_address=":0", silence_logs="CRITICAL") as empty:
        assert "has no workers" in complaint(capsys, empty.scheduler_address, tmp_path / "out")


def test_a_worker_with_another_version_is_named_with_both(local: str) -> None:
    other = origin()
    other["versions"] = other["versions"] | {"code": "0123456789abcdef", "numpy": "1.0"}
    with pytest.raises(NapfError) as caught, connected(local, other, brief()):
        pass
    lines = str(caught.value).splitlines()
    assert len(lines) == 2  # one a worker
    for line in lines:
        assert re.match(rf"--cluster {local}: worker tcp://127\.0\.0\.1:\d+ is not like this process: ", line)
        assert re.search(r"versions\.code = [0-9a-f]{16}, not 0123456789abcdef", line)
        assert "versions.numpy = " in line


def test_a_worker_that_comes_later_with_another_version_is_named(
    local: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if its version had been right when we came: it is asked again before every block."""
    monkeypatch.setattr(cluster_module, "_check_workers", lambda *_: None)
    monkeypatch.setattr("napf_mpc.provenance.versions", lambda: {"code": "0123456789abcdef"})
    with pytest.raises(NapfError, match=r"worker tcp://127\.0\.0\.1:\d+ is not like this process: versions"):
        fly(local, tmp_path)


@pytest.mark.slow
def test_a_worker_without_the_package_is_named(tmp_path: Path) -> None:
    """A package of the same name that is empty stands in the way of ours."""
    (tmp_path / "napf_mpc").mkdir()
    (tmp_path / "napf_mpc" / "__init__.py").touch()
    with scheduler() as (address, _), worker(address, tmp_path, nanny=False):
        wait_for_workers(address, 1)
        # Some versions of distributed hand on the error itself, others its text.
        told = (
            r"worker tcp://\S+ cannot load this version of napf-mpc: .*No module named \\?'napf_mpc\.cluster"
        )
        with pytest.raises(NapfError, match=told), connected(address, origin(), brief()):
            pass


def test_differences_are_none_in_the_same_process() -> None:
    assert differing(origin(), brief(), None) == []
    assert differing(origin() | {"problem_hash": "x"}, brief(), None)[0].endswith("not x")
