"""Settings such as ``world.obstacles[0].radius_m=2`` (``--set``), laid over the tables of a problem file."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

from napf_mpc.words import shown_text

__all__ = ["apply_overrides", "nested_deeper", "parse_value"]

_PATH = re.compile(r"[A-Za-z0-9_-]+(?:\.[A-Za-z0-9_-]+|\[[0-9]{1,9}\])*")
_STEP = re.compile(r"([A-Za-z0-9_-]+)|\[([0-9]+)\]")
_MAX_PATH = 200
_FORM = "must be key.path=value, for example planner.k=2 or world.obstacles[0].radius_m=1.5"
# Settings of which a problem holds only one: to set one takes the others out.
_RIVALS = (("planner", ("k", "confidence", "risk_per_mission")),)


def parse_value(text: str) -> Any:
    """Value of a setting: TOML if it is TOML, else the bare text itself.

    Parameters
    ----------
    text : str
        ``2``, ``[0.5, 2.0]``, ``true``, ``"napf"``, or bare ``napf``.
    """
    try:
        table = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    # Text with line breaks can be several TOML lines; a setting is one value.
    return table["value"] if table.keys() == {"value"} else text


def nested_deeper(value: object, levels: int) -> bool:
    """Whether tables and lists are nested deeper than so many levels (without recursion)."""
    layer = [value]
    for _ in range(levels + 1):
        layer = [
            entry
            for container in layer
            if isinstance(container, (dict, list, tuple))
            for entry in (container.values() if isinstance(container, dict) else container)
        ]
    return bool(layer)


def apply_overrides(
    data: dict[str, Any], overrides: Mapping[str, object] | Sequence[str]
) -> tuple[dict[str, Any], list[str]]:
    """Lay settings over the tables of a problem file.

    Parameters
    ----------
    data : dict
        Tables as tomllib gives them. Left as it is.
    overrides : mapping of str to object, or sequence of str
        Key path -> value, or ``"key.path=value"`` lines. Text is read as TOML (:func:`parse_value`); other
        values are taken as they are, those of NumPy as Python's. Tables that the file does not have are made;
        entries of lists must exist. ``planner.k`` takes the file's ``planner.confidence`` out, and the other
        way round, unless both are set.

    Returns
    -------
    dict
        A copy with the settings in it; keys that no problem has are found later, with the file's.
    list of str
        One line for each setting that cannot be laid over the file.
    """
    data = _copied(data)
    faults: list[str] = []
    paths: list[tuple[str, tuple[str | int, ...]]] = []
    for name, value in _pairs(overrides, faults):
        path = _parse_path(name)
        if path is None:
            faults.append(f'setting "{shown_text(name, 80)}": {_FORM}')
            continue
        paths.append((name, path))
        fault = _put(data, path, value)
        if fault:
            faults.append(f'setting "{shown_text(name, 80)}": {fault}')
    given = {path for _, path in paths}
    for section, rivals in _RIVALS:
        table = data.get(section)
        if isinstance(table, dict) and any((section, name) in given for name in rivals):
            for name in rivals:
                if (section, name) not in given:
                    table.pop(name, None)
    return data, faults


def _pairs(overrides: Mapping[str, object] | Sequence[str], faults: list[str]) -> list[tuple[str, object]]:
    if isinstance(overrides, Mapping):
        items = [(str(name), value) for name, value in overrides.items()]
        return [(name, parse_value(v) if isinstance(v, str) else _copied(v)) for name, v in items]
    pairs: list[tuple[str, object]] = []
    for line in (overrides,) if isinstance(overrides, str) else overrides:
        name, equals, text = str(line).partition("=")
        if equals:
            pairs.append((name.strip(), parse_value(text.strip())))
        else:
            faults.append(f'setting "{shown_text(name, 80)}": {_FORM}')
    return pairs


def _parse_path(text: str) -> tuple[str | int, ...] | None:
    """Take ``a.b[0].c`` or ``a.b.0.c`` apart; None if it is neither."""
    if len(text) > _MAX_PATH or not _PATH.fullmatch(text):
        return None
    return tuple(int(index) if index else name for name, index in _STEP.findall(text))


def _put(data: dict[str, Any], path: tuple[str | int, ...], value: object) -> str | None:
    """Set one value; the fault in words if there is no such place."""
    here: Any = data
    walked = ""
    for step, is_last in zip(path, [False] * (len(path) - 1) + [True], strict=True):
        if isinstance(here, list):
            index = int(step) if str(step).isdecimal() and len(str(step)) < 10 else -1
            if not 0 <= index < len(here):
                return f"{walked} has {len(here)} entries, counted from 0; there is no {step}"
            key: Any = index
            walked += f"[{index}]"
        elif isinstance(here, dict):
            if isinstance(step, int):
                return f"{walked} is not a list in the file; set it as a whole"
            key = step
            walked += f".{step}" if walked else step
        else:
            return f"{walked} is not a table or list in the file; set it as a whole"
        if is_last:
            here[key] = value
        elif isinstance(here, dict):
            here = here.setdefault(key, {})
        else:
            here = here[key]
    return None


def _copied(value: Any) -> Any:
    """Copy tables and lists (depth is limited by the caller), numbers and arrays of NumPy as Python's own."""
    if isinstance(value, dict):
        return {key: _copied(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_copied(entry) for entry in value]
    # NumPy itself would double the time that reading a problem takes.
    return _copied(value.tolist()) if hasattr(value, "tolist") else value
