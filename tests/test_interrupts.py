"""Ctrl-C, SIGTERM, kill -9: a clean stop, nothing left; ``test_campaign_torture.py`` goes on from there."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("resource", reason="signals and process groups are POSIX")

from campaign_torture import PROBLEM, START, finished, left_over

MANY = 9600
"""Runs of a campaign that is not meant to end by itself."""


def command(out: Path, *options: str) -> list[str]:
    problem = out.parent / "problem.toml"
    problem.write_text(PROBLEM)
    words = [
        "montecarlo",
        str(problem),
        "--planner",
        "apf",
        "--runs",
        str(MANY),
        "--seed",
        "3",
        "--out",
        str(out),
    ]
    return [sys.executable, "-c", START, *words, "--quiet", *options]


@contextlib.contextmanager
def started(out: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """Start a campaign as the leader of a group of its own; whatever is left of it goes at the end."""
    process = subprocess.Popen(
        command(out, *options),
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def wait_until_flying(out: Path, process: subprocess.Popen[str], blocks: int = 0) -> None:
    deadline = time.monotonic() + 120.0
    while process.poll() is None and time.monotonic() < deadline:
        if (out / ".lock").exists() and len(finished(out)) >= blocks:
            return
        time.sleep(0.01)
    raise AssertionError(f"ended before it could be stopped: {process.communicate()}")


@pytest.mark.parametrize(
    ("signum", "workers", "group"),
    [
        (signal.SIGINT, 1, True),  # Ctrl-C at a terminal
        (signal.SIGINT, 2, True),
        (signal.SIGTERM, 1, False),  # kill
        (signal.SIGTERM, 2, True),  # an init system that ends a service
    ],
)
def test_a_stop_is_prompt_keeps_blocks_and_leaves_nothing_behind(
    signum: signal.Signals, workers: int, group: bool, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with started(out, "--workers", str(workers)) as process:
        wait_until_flying(out, process, blocks=1)
        before = time.monotonic()
        os.killpg(process.pid, signum) if group else process.send_signal(signum)
        stdout, stderr = process.communicate(timeout=30)
        took = time.monotonic() - before
        assert left_over(process.pid, before + 3.0 - time.monotonic()) == []
    assert process.returncode == 128 + signum
    assert took < 3.0
    assert stdout == ""
    told = re.fullmatch(
        rf"stopped: (\d+) of {MANY} runs are kept in {re.escape(str(out))}; repeat the command to go on\n",
        stderr,
    )
    assert told, stderr
    # A block may have come to the disk just before the stop and not have been counted yet.
    assert 16 * len(finished(out)) - int(told[1]) in (0, 16)


HIT = """
import os, signal
from napf_mpc import interrupts
def hit():
    os.kill(os.getpid(), signal.SIGTERM)
    for _ in range(1000):
        pass
class Finaliser:
    def __del__(self):
        hit()
def in_a_finaliser():
    Finaliser()
def in_somebody_elses_code():
    try:
        hit()
    except BaseException:
        raise ImportError("something else") from None
def command():
    {where}()
    return 0
interrupts.run(command)
"""


@pytest.mark.parametrize("where", ["hit", "in_a_finaliser", "in_somebody_elses_code"])
def test_a_stop_is_a_stop_wherever_it_hits(where: str) -> None:
    script = HIT.replace("{where}", where)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (143, "", "stopped\n")


def test_an_error_of_its_own_is_told_as_ever() -> None:
    script = "from napf_mpc import interrupts; interrupts.run(lambda: 1 // 0)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 1
    assert "ZeroDivisionError" in done.stderr


def test_workers_end_with_a_process_that_was_killed(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with started(out, "--workers", "2") as process:
        wait_until_flying(out, process, blocks=1)
        process.kill()  # this process alone: its workers get no signal
        process.wait()
        assert left_over(process.pid) == []


STUCK = """
import time
from napf_mpc import interrupts
def command():
    while True:
        try:
            print("ready", flush=True)
            time.sleep(60)
        except BaseException:
            pass
interrupts.run(command)
"""


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_comes_for_certain_whatever_hangs(signum: signal.Signals) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", STUCK], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    before = time.monotonic()
    process.send_signal(signum)
    _, stderr = process.communicate(timeout=30)
    assert time.monotonic() - before < 3.0
    assert (process.returncode, stderr) == (128 + signum, "stopped\n")


LEAKY = """
import os
from multiprocessing import resource_tracker as ours
from joblib.externals.loky.backend import resource_tracker as lokys
from napf_mpc.workers import _without_interrupts
with _without_interrupts():
    pass
assert "PYTHONWARNINGS" not in os.environ
for tracker, kind in ((ours, "semaphore"), (lokys, "semlock")):
    tracker.register("/not_there_any_more", kind)
os._exit(130)
"""


def test_what_a_stop_leaves_is_tidied_up_without_a_word() -> None:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONWARNINGS"}
    done = subprocess.run([sys.executable, "-c", LEAKY], capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_a_stop_without_an_output_folder_says_that_nothing_is_kept(tmp_path: Path) -> None:
    words = command(tmp_path / "out", "--workers", "1")
    words[words.index("montecarlo")] = "compare"
    for option in ("--planner", "--out"):
        del words[words.index(option) : words.index(option) + 2]
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    process = subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
    )
    deadline = time.monotonic() + 60.0
    while not list(tmp_path.glob("napf-mpc-*/blocks/rows_*")) and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=30)
    assert process.returncode == 130
    assert stderr == "stopped: nothing is kept without --out\n"
    assert not list(tmp_path.glob("napf-mpc-*"))
