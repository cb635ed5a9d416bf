"""How values from files and settings appear in messages: short, on one line, without control characters."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator
from typing import Any

__all__ = ["did_you_mean", "nearest", "shown_key_path", "shown_number", "shown_text", "shown_value"]

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def shown_text(text: str, length: int = 60) -> str:
    """Text cut to ``length`` characters, with everything unprintable escaped."""
    cut = text if len(text) <= length else text[: max(length - 3, 0)] + "..."
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in cut)


def shown_number(number: float) -> str:
    """Write a limit the way one would in a file: 100000, 0.01, 1e-06."""
    return f"{number:.10g}"


def shown_value(value: Any, length: int = 60) -> str:
    """Write a value as in TOML and cut it to ``length`` characters."""
    text = ""
    for piece in _pieces(value, length):
        text += piece
        if len(text) > length:
            return text[: length - 3] + "..."
    return text


def _pieces(value: Any, length: int) -> Iterator[str]:
    """Yield the text bit by bit: a list of a million entries is never written out to be cut afterwards."""
    if isinstance(value, bool):
        yield "true" if value else "false"
    elif isinstance(value, str):
        yield f'"{shown_text(value, length - 2)}"'
    elif isinstance(value, int):
        # Python refuses to write out numbers of thousands of digits.
        yield str(value) if value.bit_length() <= 200 else "an integer of more than 60 digits"
    elif isinstance(value, dict):
        yield "{"
        for i, (key, entry) in enumerate(value.items()):
            yield (", " if i else "") + _shown_key(str(key)) + " = "
            yield from _pieces(entry, length)
        yield "}"
    elif isinstance(value, (list, tuple)):
        yield "["
        for i, entry in enumerate(value):
            if i:
                yield ", "
            yield from _pieces(entry, length)
        yield "]"
    else:  # floats, dates and times, and whatever a library user hands over
        yield shown_text(str(value), length)


def _shown_key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) and len(key) <= 60 else f'"{shown_text(key)}"'


def shown_key_path(path: Iterable[str | int]) -> str:
    """Write ``("world", "obstacles", 3, "radius_m")`` as ``world.obstacles[3].radius_m``."""
    text = ""
    for step in path:
        if isinstance(step, int):
            text += f"[{step}]"
        else:
            text += ("." if text else "") + _shown_key(step)
    return text


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Known name that a misspelt one most likely means; None if none is near."""
    names = list(known)
    if len(word) > 200:  # the comparison is quadratic and no name is that long
        return None
    folded = {name.casefold(): name for name in names}
    found = difflib.get_close_matches(word.casefold(), folded, n=1, cutoff=0.6)
    return folded[found[0]] if found else None


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Ending of a message that names the nearest known name, or nothing."""
    near = nearest(word, known)
    return f"; did you mean {near}?" if near else ""
