"""Reading and checking problem files (TOML).

Input is data from anybody: whatever a file holds, the answer is a valid problem or a
:class:`~napf_mpc.errors.ProblemError` that lists everything that is wrong with it.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from napf_mpc.errors import ProblemError
from napf_mpc.overrides import apply_overrides, nested_deeper
from napf_mpc.problem import Problem
from napf_mpc.problem_faults import describe_faults
from napf_mpc.shipped import shipped_problems
from napf_mpc.words import shown_text

__all__ = ["load_problem", "problem_schema"]

MAX_BYTES = 10_000_000
MAX_DEPTH = 20
MAX_KEY_PARTS = 50
MAX_BITS = (
    300  # far beyond every limit; pydantic writes integers out in decimal, where Python refuses long ones
)
# A section without a kind is of this kind; the model itself tells kinds apart by the key alone.
_DEFAULT_KINDS = {"mission": "formation", "navigation": "gauss_markov"}


def load_problem(file: str | Path, overrides: Mapping[str, object] | Sequence[str] = ()) -> Problem:
    """Read and check a problem file.

    Parameters
    ----------
    file : str or Path
        Path of a TOML file of at most 10 MB, or the name of a shipped problem such as ``"table1_8"``
        (:func:`napf_mpc.shipped.shipped_problems`). A file of that name in the current folder goes first.
    overrides : mapping of str to object, or sequence of str
        Settings laid over the file and checked like it: ``{"planner.k": "2"}``, or lines such as
        ``"world.obstacles[0].radius_m=2"``. See :func:`napf_mpc.overrides.apply_overrides`; ``planner.k``
        takes the file's ``planner.confidence`` out, and the other way round.

    Returns
    -------
    Problem
        Valid and immutable.

    Raises
    ------
    ProblemError
        The file cannot be read, is not TOML, or holds unknown, missing or impossible values: one line for
        each, with key path, value and what is allowed.
    """
    path = _locate(file)
    source = shown_text(str(path), 200)
    data = _parse(_read(path, source), source)
    data, faults = apply_overrides(data, overrides)
    if faults:
        raise ProblemError(source, faults)
    _refuse_deep(data, source)
    return _validate(data, source)


def problem_schema() -> dict[str, Any]:
    """JSON Schema of a problem file, for editors and other programs.

    Returns
    -------
    dict
        Draft 2020-12. It holds names, types, ranges and defaults; relations between keys (such as
        ``planner.k`` against ``planner.confidence``) are checked by :func:`load_problem` only.
    """
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **Problem.model_json_schema()}


def _locate(file: str | Path) -> Path:
    path = Path(file)
    try:
        if path.is_file():
            return path
        exists = path.exists()
    except (OSError, ValueError):  # name too long, NUL in it, no permission
        exists = False
    shipped = shipped_problems()
    name = str(file).removesuffix(".toml")
    if name in shipped:
        return shipped[name]
    if exists:
        return path
    near = difflib.get_close_matches(path.name.removesuffix(".toml")[:100], shipped, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else f"shipped problems: {', '.join(shipped)}"
    raise ProblemError(
        shown_text(str(file), 200), [f"no such file and no shipped problem of this name; {hint}"]
    )


def _read(path: Path, source: str) -> str:
    if path.is_dir():
        raise ProblemError(source, ["is a folder; give a problem file (.toml)"])
    try:
        with path.open("rb") as stream:
            content = stream.read(MAX_BYTES + 1)
    except OSError as error:
        raise ProblemError(source, [f"cannot be read: {error.strerror or error}"]) from error
    if len(content) > MAX_BYTES:
        raise ProblemError(
            source, [f"is larger than {MAX_BYTES // 1_000_000} MB, the most a problem may have"]
        )
    try:
        return content.decode("utf-8-sig")  # some editors put a byte order mark in front
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise ProblemError(source, [f"is not UTF-8 text (line {line}); save it as UTF-8"]) from error


def _parse(text: str, source: str) -> dict[str, Any]:
    _refuse_long_keys(text, source)
    try:
        data = tomllib.loads(text)
    except RecursionError as error:
        raise ProblemError(source, ["is nested too deeply for a problem"]) from error
    except ValueError as error:  # TOMLDecodeError, and numbers of thousands of digits
        raise ProblemError(source, [f"is not TOML: {shown_text(str(error), 200)}"]) from error
    _refuse_deep(data, source)
    return data


def _refuse_long_keys(text: str, source: str) -> None:
    """Refuse dotted keys that would take hours: tomllib's time grows with the square of their parts."""
    unquoted = re.sub(r""""(?:[^"\\\n]|\\.)*"|'[^'\n]*'""", "q", text)  # quoted parts may hold anything
    for piece in re.split(r"[=,{\n]", unquoted):
        if piece.count(".") > MAX_KEY_PARTS:
            parts = len(re.findall(r"\.(?![.\s])", piece))  # rows of dots in a text are no key
            if parts > MAX_KEY_PARTS:
                raise ProblemError(source, [f"has a key of more than {MAX_KEY_PARTS} parts; no problem has"])


def _refuse_deep(data: dict[str, Any], source: str) -> None:
    if nested_deeper(data, MAX_DEPTH):
        raise ProblemError(source, [f"is nested deeper than {MAX_DEPTH} levels; no problem is"])


def _validate(data: dict[str, Any], source: str) -> Problem:
    for section, kind in _DEFAULT_KINDS.items():
        table = data.get(section)
        if isinstance(table, dict):
            table.setdefault("kind", kind)
    try:
        return Problem.model_validate(_tuples(data))
    except ValidationError as error:
        raise ProblemError(source, describe_faults(error)) from error


def _tuples(value: Any) -> Any:
    """Lists as tuples, all that the strict model takes; integers cut to a size that can be printed."""
    if isinstance(value, dict):
        return {key: _tuples(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return tuple(_tuples(entry) for entry in value)
    if isinstance(value, int) and value.bit_length() > MAX_BITS:
        return 2**MAX_BITS if value > 0 else -(2**MAX_BITS)
    return value
