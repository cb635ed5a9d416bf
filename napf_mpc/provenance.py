"""What decides a result: problem, data, seed, planners and code. Results of two origins are never mixed."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from napf_mpc import __version__
from napf_mpc.data_folder import find_data_file
from napf_mpc.problem import City, Gnss, Problem, Recorded

_SHOWING = {"__main__.py", "benchmark", "cli.py", "figures.py", "interrupts.py", "report.py", "plot"}
"""Modules that only show or time results: editing them leaves results as they are."""


@cache
def versions() -> dict[str, str]:
    """Versions of what decides a result; ``code`` is a digest of this package's own source."""
    packages = ("numpy", "scipy", "numba", "casadi", "pyarrow")
    return {
        "python": platform.python_version(),
        "napf-mpc": __version__,
        **{name: metadata.version(name) for name in packages},
        "code": _code_digest()[:16],
    }


def processor() -> str:
    """Model of the processor, as far as the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []  # not Linux
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return next(iter(named), "") or platform.processor() or platform.machine()


def _code_digest() -> str:
    root = Path(__file__).resolve().parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        name = path.relative_to(root)
        if name.parts[0] not in _SHOWING:
            digest.update(name.as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def data_files(problem: Problem) -> list[str]:
    """Data files that a problem names, as paths under the data folder."""
    named: list[str | None] = []
    if isinstance(problem.world, City):
        named.append(problem.world.file)
    if isinstance(problem.navigation, Recorded):
        named += [problem.navigation.file, problem.navigation.truth_file]
    if isinstance(problem.navigation, Gnss):
        named.append(problem.navigation.file)
    return [name for name in named if name is not None]


def data_digests(problem: Problem, data_folder: Path | None = None) -> dict[str, str]:
    """SHA-256 of every data file that a problem names.

    Raises
    ------
    DataError
        If one is missing.
    """
    digests = {}
    for name in data_files(problem):
        with find_data_file(name, data_folder).open("rb") as file:
            digests[name] = hashlib.file_digest(file, "sha256").hexdigest()
    return digests


def identity(
    problem: Problem, name: str, planners: Sequence[str], seed: int, data_folder: Path | None = None
) -> dict[str, Any]:
    """Everything that decides the results of a campaign, but for its number of runs.

    Parameters
    ----------
    problem : Problem
        What is flown.
    name : str
        What it is called; for the reader, it decides nothing.
    planners : sequence of str
        Names of planners; of registered ones, and of a registered solver, the source's digest is part of the
        identity.
    seed : int
        Campaign seed.
    data_folder : Path, optional
        Where data files lie.

    Raises
    ------
    DataError
        If a data file is missing.
    """
    from napf_mpc.own_parts import OwnParts  # only here: planners cost start-up time

    return {
        "problem": name,
        "problem_hash": problem.digest(),
        "data": data_digests(problem, data_folder),
        "seed": int(seed),
        "planners": list(planners),
        **OwnParts.of(problem, planners).digests(),
        "versions": versions(),
    }


def differences(held: Mapping[str, Any], ours: Mapping[str, Any]) -> list[str]:
    """One line for each entry of two identities that differs: ``seed = 7, not 8``; names do not count."""
    lines = []
    for key in dict.fromkeys([*ours, *held]):
        there, here = held.get(key), ours.get(key)
        if key == "problem" or there == here:
            continue
        if isinstance(there, dict) and isinstance(here, dict):
            lines += [f"{key}.{line}" for line in differences(there, here)]
        else:
            lines.append(f"{key} = {_shown(there)}, not {_shown(here)}")
    return lines


def _shown(value: Any) -> str:
    if value is None:
        return "none"
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)[:200]
