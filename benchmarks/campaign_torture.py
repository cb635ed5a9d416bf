"""Whether a campaign survives signals, kills, dead workers and full disks at random moments.

Run ``python benchmarks/campaign_torture.py``; it prints a row for each kind of disturbance. A campaign of the
command line is disturbed, then the same command is given again, until it is through. Then the hash of
``runs.parquet`` has to be that of an undisturbed campaign, no block that was finished may be gone, no process
left over and no run filed as failed. POSIX only. Disks are tmpfs mounts of random size; where mounting is not
permitted, a limit on the size of files stands in for them, and the table says so.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import IO

from napf_mpc import store

PROBLEM = """
# 64 UAVs: sixteen runs fill a block, so that a short campaign has some of them.
[formation]
shape = "line"
count = 64
[mission]
length_m = 100.0
[world]
kind = "lanes"
count = 8
along_range_m = [3.0, 9.0]
[simulation]
time_limit_s = 2.5
"""
START = (
    # Without figures, which take longer than these flights.
    "import sys, types; from napf_mpc.__main__ import main;"
    "sys.modules['napf_mpc.figures'] = types.SimpleNamespace(draw_comparison=lambda *_: []); main()"
)
STOP_S = 3.0
PAGE = 4096


@dataclass
class Tally:
    """What disturbances of one kind did; everything but the first three has to be zero."""

    disturbed: int = 0
    """Times that a campaign was disturbed before it was through."""
    through: int = 0
    """Campaigns that were through, by themselves or at last."""
    slowest_s: float = 0.0
    """From a signal to the end of the process."""
    late: int = 0
    """Stops that took longer than they may."""
    odd: int = 0
    """Ends with another exit code or other words than promised."""
    orphans: int = 0
    """Processes left over."""
    gone: int = 0
    """Finished blocks that were not there any more."""
    filed: int = 0
    """Runs filed as lost."""
    different: int = 0
    """Campaigns with another hash than the undisturbed one."""
    words: list[str] = field(default_factory=list)
    """What odd ends said."""


class Torture:
    """A campaign of some runs, and ways to disturb it.

    Parameters
    ----------
    folder : Path
        Where its results go; empty.
    runs, workers : int
        Of the campaign.
    seed : int
        Of the random moments; the campaign has its own.
    """

    def __init__(self, folder: Path, runs: int, workers: int, seed: int) -> None:
        self._folder = folder
        self._runs = runs
        self._workers = workers
        self._moments = random.Random(seed)
        self._count = 0
        (folder / "problem.toml").write_text(PROBLEM, encoding="utf-8")
        self._undisturbed()  # the first one may compile: disturbances spread over that time come too late
        began = time.monotonic()
        self._whole = self._undisturbed()
        self._took_s = time.monotonic() - began
        self.expected = digest(self._whole)

    def _undisturbed(self) -> Path:
        out = self.fresh()
        with self._started(out) as process:
            _, words = process.communicate()
        if process.returncode != 0:
            raise SystemExit(f"the undisturbed campaign failed: {words}")
        return out

    def fresh(self) -> Path:
        """Name a folder that is not there yet."""
        self._count += 1
        return self._folder / f"out{self._count}"

    @contextlib.contextmanager
    def _started(self, out: Path, limit: int | None = None) -> Iterator[subprocess.Popen[str]]:
        """Start the command as leader of a group of its own; whatever is left of it goes at the end."""
        words = ["montecarlo", str(self._folder / "problem.toml"), "--planner", "apf", "--seed", "3"]
        words += ["--runs", str(self._runs), "--workers", str(self._workers), "--out", str(out), "--quiet"]
        process = subprocess.Popen(
            [sys.executable, "-c", START, *words],
            start_new_session=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=None if limit is None else lambda: _limit_files(limit),
        )
        try:
            yield process
        finally:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
            process.communicate()

    @staticmethod
    def _tries(tally: Tally, times: int) -> Iterator[None]:
        """Go on until there were enough disturbances: some moments come too late, but not nearly all."""
        most = 10 + 5 * times
        for _ in range(most):
            if tally.disturbed >= times:
                return
            yield
        if tally.disturbed < times:
            raise SystemExit(f"{tally.disturbed} disturbances in {most} campaigns: too few to mean much")

    def signals(self, times: int, signum: int, *, group: bool) -> Tally:
        """Send a signal at a random moment, and go on, again and again."""
        tally = Tally()
        out = self.fresh()
        for _ in self._tries(tally, times):
            kept = set(finished(out))
            with self._started(out) as process:
                time.sleep(self._moments.uniform(0.0, self._took_s))
                before = time.monotonic()
                through = process.poll() is not None
                if not through:
                    with contextlib.suppress(ProcessLookupError):
                        os.killpg(process.pid, signum) if group else process.send_signal(signum)
                _, words = process.communicate()
                took_s = time.monotonic() - before
                tally.orphans += len(left_over(process.pid))
            tally.gone += len(kept - set(finished(out)))
            if process.returncode == 0:
                out = self._through(out, tally)
                continue
            tally.disturbed += 1
            if signum == signal.SIGKILL:
                # The words, if any, are of a process of joblib's that tidies up behind the dead.
                self._expect(tally, process.returncode == -signum, words)
            else:
                tally.slowest_s = max(tally.slowest_s, took_s)
                tally.late += took_s > STOP_S
                told = re.fullmatch(r"stopped(: \d+ of \d+ runs are kept .*)?\n", words)
                # While Python was starting: our handlers, once there, raise no KeyboardInterrupt.
                own_end = not words or words.endswith("KeyboardInterrupt\n")
                early = own_end and process.returncode in (-signum, 1)
                self._expect(tally, early or (process.returncode == 128 + signum and bool(told)), words)
        self._finish(out, tally)
        return tally

    def dead_workers(self, times: int) -> Tally:
        """Kill one worker at a random moment of each campaign."""
        tally = Tally()
        for _ in self._tries(tally, times):
            out = self.fresh()
            with self._started(out) as process:
                time.sleep(self._moments.uniform(0.0, self._took_s))
                victims = workers_of(process.pid)
                if victims:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(self._moments.choice(victims), signal.SIGKILL)
                        tally.disturbed += 1
                _, words = process.communicate()
                tally.orphans += len(left_over(process.pid))
            self._expect(tally, process.returncode == 0 and words == "", words)
            self._through(out, tally)
        return tally

    def full_disks(self, times: int, mounts: bool) -> Tally:
        """Let the disk be full at a random moment, then make room."""
        tally = Tally()
        used = [-(-path.stat().st_size // PAGE) * PAGE for path in self._whole.rglob("*") if path.is_file()]
        for _ in self._tries(tally, times):
            disk = self.fresh()
            disk.mkdir()
            out = disk / "out"
            room = (
                self._moments.randrange(4 * PAGE, sum(used)) if mounts else self._moments.randrange(max(used))
            )
            with mounted(disk, room) if mounts else contextlib.nullcontext():
                with self._started(out, None if mounts else room) as process:
                    _, words = process.communicate()
                    tally.orphans += len(left_over(process.pid))
                if process.returncode == 0:
                    self._compare(out, tally)
                    continue
                tally.disturbed += 1
                cause = "No space left on device" if mounts else "File too large"
                named = re.fullmatch(rf"error: {re.escape(str(disk))}\S*: .*{cause}.*\n", words)
                self._expect(tally, process.returncode == 2 and bool(named), words)
                kept = set(finished(out))
                if mounts:
                    remount(disk)
                with self._started(out) as process:
                    _, words = process.communicate()
                tally.gone += len(kept - set(finished(out)))
                self._expect(tally, process.returncode == 0 and words == "", words)
                self._compare(out, tally)
        return tally

    def _finish(self, out: Path, tally: Tally) -> None:
        with self._started(out) as process:
            _, words = process.communicate()
        self._expect(tally, process.returncode == 0 and words == "", words)
        self._through(out, tally)

    def _through(self, out: Path, tally: Tally) -> Path:
        self._compare(out, tally)
        shutil.rmtree(out)
        return self.fresh()

    def _compare(self, out: Path, tally: Tally) -> None:
        tally.through += 1
        tally.different += digest(out) != self.expected
        tally.filed += int((store.read_table(out / "runs.parquet")["reason"] != "").sum())

    def _expect(self, tally: Tally, as_promised: bool, words: str) -> None:
        if not as_promised:
            tally.odd += 1
            tally.words.append(words)


def digest(out: Path) -> str:
    """Hash of a campaign's table of runs; empty if there is none."""
    path = out / "runs.parquet"
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else ""


def finished(out: Path) -> list[str]:
    """Names of finished blocks."""
    return sorted(path.name for path in (out / "blocks").glob("rows_*.parquet"))


def processes() -> list[list[str]]:
    """Process, its parent, its group, its state and its command."""
    words = ["ps", "-A", "-ww", "-o", "pid=,ppid=,pgid=,stat=,args="]
    listed = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    return [line.split(None, 4) for line in listed.splitlines()]


def workers_of(parent: int) -> list[int]:
    """Workers that fly for a process, not those that only watch over its memory."""
    return [int(row[0]) for row in processes() if row[1] == str(parent) and "popen_loky" in row[4]]


def left_over(group: int, patience_s: float = 10.0) -> list[str]:
    """Processes of a group that still run after a while; the dead that nobody has looked at do not count."""
    deadline = time.monotonic() + patience_s
    while True:
        left = [row[4] for row in processes() if row[2] == str(group) and not row[3].startswith("Z")]
        if not left or time.monotonic() > deadline:
            return left
        time.sleep(0.1)


def _limit_files(size: int) -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


@contextlib.contextmanager
def mounted(folder: Path, size: int) -> Iterator[None]:
    """Let a folder be a disk of some size [bytes]."""
    words = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    subprocess.run(words, capture_output=True, check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def remount(folder: Path) -> None:
    """Make room on a disk of ours."""
    subprocess.run(["mount", "-o", "remount,size=64m", str(folder)], check=True)


def may_mount(folder: Path) -> bool:
    """Whether this process may make disks."""
    place = folder / "mount"
    place.mkdir()
    try:
        with mounted(place, PAGE):
            return True
    except (OSError, subprocess.CalledProcessError):
        return False
    finally:
        place.rmdir()


def full_disk(folder: Path) -> str:
    """Name the kind of full disk that this process may make."""
    return "disk full" if may_mount(folder) else "file too large"


KINDS: dict[str, Callable[[Torture, int], Tally]] = {
    "kill -9 of the group": lambda torture, n: torture.signals(n, signal.SIGKILL, group=True),
    "kill -9 of the parent": lambda torture, n: torture.signals(n, signal.SIGKILL, group=False),
    "Ctrl-C": lambda torture, n: torture.signals(n, signal.SIGINT, group=True),
    "SIGTERM": lambda torture, n: torture.signals(n, signal.SIGTERM, group=False),
    "kill -9 of a worker": Torture.dead_workers,
    "disk full": lambda torture, n: torture.full_disks(n, mounts=True),
    "file too large": lambda torture, n: torture.full_disks(n, mounts=False),
}


def torture_all(
    counts: dict[str, int], folder: Path, runs: int, workers: int, seed: int, file: IO[str] = sys.stdout
) -> dict[str, Tally]:
    """Disturb campaigns in every way asked for and print a table."""
    torture = Torture(folder, runs, workers, seed)
    names = [entry.name for entry in fields(Tally) if entry.name != "words"]
    print(f"{runs} runs, {workers} workers; undisturbed: sha256 {torture.expected}", file=file)
    print(f"{'disturbance':<22}" + "".join(f"{name:>10}" for name in names), file=file)
    tallies = {}
    for kind, count in counts.items():
        tally = tallies[kind] = KINDS[kind](torture, count)
        shown = [
            f"{getattr(tally, name):.2f}" if name == "slowest_s" else getattr(tally, name) for name in names
        ]
        print(f"{kind:<22}" + "".join(f"{value:>10}" for value in shown), file=file, flush=True)
        for words in tally.words:
            print(f"    odd: {words!r}", file=file)
    return tallies


def good(tally: Tally) -> bool:
    """Whether disturbances did no harm; being late is for whoever knows how busy the machine is."""
    return not (tally.odd or tally.orphans or tally.gone or tally.filed or tally.different)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--times", type=int, default=50, help="disturbances of each kind")
    parser.add_argument("--disks", type=int, default=10, help="full disks")
    parser.add_argument("--runs", type=int, default=96, help="runs of the campaign, 16 a block")
    parser.add_argument("--workers", type=int, default=2, help="worker processes")
    parser.add_argument("--seed", type=int, default=1, help="of the random moments")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, help="default: all that this system permits")
    asked = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="torture-") as name:
        folder = Path(name)
        disk = full_disk(folder)
        if disk != "disk full":
            print("mounting is not permitted: a limit on the size of files stands in for full disks")
        kinds = asked.kinds or [kind for kind in KINDS if kind not in ("disk full", "file too large")] + [
            disk
        ]
        counts = {
            kind: asked.disks if kind in ("disk full", "file too large") else asked.times for kind in kinds
        }
        tallies = torture_all(counts, folder, asked.runs, asked.workers, asked.seed)
    return 0 if all(good(tally) and not tally.late for tally in tallies.values()) else 1


if __name__ == "__main__":
    raise SystemExit(main())
