"""What is wrong with a problem file, in words: key path, value, what is allowed.

The limits are read from the model itself, so that the words cannot differ from what is checked.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from napf_mpc.problem import Problem
from napf_mpc.words import did_you_mean, nearest, shown_key_path, shown_number, shown_text, shown_value

__all__ = ["describe_faults"]

MAX_LINES = 200
KEYS_SHOWN = 12
"""Keys of a table that a message lists at most; one line holds no more."""
_OUT_OF_RANGE = {"greater_than", "greater_than_equal", "less_than", "less_than_equal"}


@dataclass(frozen=True)
class _Place:
    """A place in the model: its type and the limits on it."""

    annotation: Any
    limits: Mapping[str, Any]
    tag: str | None = None
    """Key that tells the kinds of a union apart."""

    @classmethod
    def of(cls, annotation: Any, metadata: tuple[Any, ...] = (), tag: str | None = None) -> _Place:
        """Look through ``Annotated`` and ``| None``."""
        found = list(metadata)
        while True:
            if get_origin(annotation) is Annotated:
                annotation, *inner = get_args(annotation)
                found += inner
            elif get_origin(annotation) in (Union, UnionType) and NoneType in get_args(annotation):
                others = tuple(arg for arg in get_args(annotation) if arg is not NoneType)
                annotation = others[0] if len(others) == 1 else Union[others]  # noqa: UP007
            else:
                break
        limits: dict[str, Any] = {}
        for item in found:
            if isinstance(item, FieldInfo):
                tag = tag or (item.discriminator if isinstance(item.discriminator, str) else None)
            for entry in item.metadata if isinstance(item, FieldInfo) else [item]:
                for name in ("gt", "ge", "lt", "le", "min_length", "max_length"):
                    limit = getattr(entry, name, None)
                    if limit is not None:
                        limits[name] = limit
        return cls(annotation, limits, tag)

    @property
    def model(self) -> type[BaseModel] | None:
        return (
            self.annotation
            if isinstance(self.annotation, type) and issubclass(self.annotation, BaseModel)
            else None
        )

    def kinds(self) -> dict[str, type[BaseModel]]:
        """Give name -> model of a union told apart by a key; empty for anything else."""
        found: dict[str, type[BaseModel]] = {}
        if self.tag is not None:
            for model in get_args(self.annotation):
                for name in get_args(model.model_fields[self.tag].annotation):
                    found[name] = model
        return found

    def entry(self, index: int) -> _Place | None:
        """Give the place of one entry of a list."""
        args = get_args(self.annotation)
        if get_origin(self.annotation) is not tuple or not args:
            return None
        if args[-1] is Ellipsis:
            return _Place.of(args[0])
        return _Place.of(args[index]) if index < len(args) else None

    def field(self, name: str) -> _Place | None:
        """Give the place of one key of a table."""
        if get_origin(self.annotation) is dict:
            return _Place.of(get_args(self.annotation)[1])
        info = self.model.model_fields.get(name) if self.model else None
        if info is None:
            return None
        tag = info.discriminator if isinstance(info.discriminator, str) else None
        return _Place.of(info.annotation, tuple(info.metadata), tag)


_ROOT = _Place(Problem, {})


def describe_faults(error: ValidationError) -> list[str]:
    """Turn what pydantic found into one line a fault.

    Parameters
    ----------
    error : ValidationError
        From validating tables against :class:`napf_mpc.problem.Problem`.

    Returns
    -------
    list of str
        Lines such as ``world.obstacles[3].radius_m = -1.0: must be >= 0.01 and <= 100000``, in the order
        of the model, at most 200 and then how many more there are.
    """
    lines: dict[str, None] = {}  # a set that keeps the order: twelve missing entries are one short list
    for details in error.errors(include_url=False):
        for line in _lines(details):
            lines[line] = None
    shown = list(lines)
    if len(shown) > MAX_LINES:
        shown = [*shown[:MAX_LINES], f"... and {len(shown) - MAX_LINES} more faults"]
    return shown


def _lines(details: ErrorDetails) -> Iterator[str]:
    kind, value = details["type"], details["input"]
    path, places = _walk(details["loc"])
    if path and path[-1] == "[key]":  # pydantic's mark for the name of a free table's key
        names = get_args(_Place.of(get_args(places[-3].annotation)[0]).annotation) if places[-3] else ()
        near = did_you_mean(str(value), names)
        yield f"{shown_key_path(path[:-1])}: unknown key; must be {_choice(names)}{near}"
        return
    place = places[-1]
    key = shown_key_path(path)
    if kind == "value_error":
        yield from _own_words(key, place, details)
    elif kind == "extra_forbidden":
        yield f"{key}: {_unknown(path, places[-2])}"
    elif kind == "missing" and path and isinstance(path[-1], int):
        # A list that is too short: pydantic misses each entry, the reader misses a length.
        yield f"{shown_key_path(path[:-1])} = {shown_value(value)}: must be {_noun(places[-2])}"
    elif kind == "missing":
        yield f"{key}: missing; must be {_noun(place)}"
    elif kind in ("union_tag_not_found", "union_tag_invalid") and isinstance(value, dict) and place:
        yield _wrong_kind(path, place, value)
    else:
        allowed = _range(place) if kind in _OUT_OF_RANGE else _noun(place)
        if kind == "finite_number":
            allowed = allowed.replace("a number", "a finite number")
        near = ""
        if kind == "literal_error" and isinstance(value, str) and place:
            near = did_you_mean(value, map(str, get_args(place.annotation)))
        yield f"{key} = {shown_value(value)}: must be {allowed or shown_text(details['msg'], 200)}{near}"


def _walk(loc: tuple[str | int, ...]) -> tuple[list[str | int], list[_Place | None]]:
    """Follow pydantic's location through the model; names of kinds are no keys and are left out."""
    path: list[str | int] = []
    places: list[_Place | None] = [_ROOT]
    for step in loc:
        place = places[-1]
        kinds = place.kinds() if place else {}
        if place and place.model is None and step in kinds:
            places[-1] = _Place(kinds[str(step)], {}, None)
            continue
        path.append(step)
        if place is None:
            places.append(None)
        elif isinstance(step, int):
            places.append(place.entry(step))
        else:
            places.append(place.field(step))
    return path, places


def _own_words(key: str, place: _Place | None, details: ErrorDetails) -> Iterator[str]:
    """Yield what a validator of ours says."""
    message = str(details.get("ctx", {}).get("error", details["msg"]))
    if not key:  # faults between sections name their keys themselves
        yield from message.split("; ")
    elif place is not None and place.model is not None:
        yield f"{key}: {message}"
    else:
        yield f"{key} = {shown_value(details['input'])}: {message}"


def _unknown(path: list[str | int], table: _Place | None) -> str:
    name = str(path[-1])
    known = list(table.model.model_fields) if table and table.model else []
    section = shown_key_path(path[:-1])
    near = nearest(name, known)
    if near:
        return f"unknown key; did you mean {section + '.' if section else ''}{near}?"
    elsewhere = [other for other in _key_paths(_ROOT, "") if other.rpartition(".")[2] == name]
    words = "unknown key"
    if table and table.model and (tag := _tag_of(table.model)):
        words += f" of {tag}"
    if section in {other.rpartition(".")[0] for other in elsewhere}:
        words += " (another kind has it)"
    elif elsewhere:
        return f"{words}; did you mean {elsewhere[0]}?"
    return f"{words}; the keys here are {', '.join(known)}"


def _tag_of(model: type[BaseModel]) -> str:
    """Give ``kind = "lanes"`` if a table is one kind of several."""
    for tag in ("kind", "shape"):
        info = model.model_fields.get(tag)
        if info is not None and get_origin(info.annotation) is Literal:
            names = get_args(info.annotation)
            if len(names) == 1:
                return f'{tag} = "{names[0]}"'
    return ""


def _key_paths(place: _Place, prefix: str) -> Iterator[str]:
    """Yield every key path of the model outside lists."""
    for model in [place.model] if place.model else place.kinds().values():
        for name in model.model_fields:
            path = f"{prefix}.{name}" if prefix else name
            yield path
            inner = _Place(model, {}).field(name)
            if inner is not None:
                yield from _key_paths(inner, path)


def _wrong_kind(path: list[str | int], place: _Place, value: Mapping[str, Any]) -> str:
    tag = str(place.tag)
    key = shown_key_path([*path, tag])
    kinds = place.kinds()
    if tag not in value:
        return f"{key}: missing; must be {_choice(kinds)}"
    given = value[tag]
    line = f"{key} = {shown_value(given)}: "
    return f"{line}must be {_choice(kinds)}" + (did_you_mean(given, kinds) if isinstance(given, str) else "")


def _choice(names: Mapping[str, Any] | tuple[Any, ...]) -> str:
    quoted = [shown_value(name) for name in names]
    return quoted[0] if len(quoted) == 1 else f"{', '.join(quoted[:-1])} or {quoted[-1]}"


def _range(place: _Place | None) -> str:
    if place is None:
        return ""
    signs = (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="))
    return " and ".join(
        f"{sign} {shown_number(place.limits[name])}" for name, sign in signs if name in place.limits
    )


def _length(place: _Place, thing: str) -> str:
    low, high = place.limits.get("min_length", 0), place.limits.get("max_length")
    if high is None:
        return f"at least {low} {thing}" if low else thing
    return f"{low} to {high} {thing}" if low else f"at most {high} {thing}"


def _noun(place: _Place | None) -> str:
    """Say what is allowed at a place, in full."""
    if place is None:
        return ""
    annotation = place.annotation
    if annotation in (float, int):
        words = "a number" if annotation is float else "a whole number"
        return f"{words} {_range(place)}".rstrip()
    if annotation is str:
        return f"text of {_length(place, 'characters')}"
    if annotation is bool:
        return "true or false"
    if get_origin(annotation) is Literal:
        return _choice(get_args(annotation))
    if get_origin(annotation) is tuple:
        return _list_noun(place)
    if get_origin(annotation) is dict:
        keys, entry = (_Place.of(arg) for arg in get_args(annotation))
        return f"a table with keys out of {_noun(keys)}, each {_noun(entry)}"
    if kinds := place.kinds():
        return f"a table with {place.tag} = {_choice(kinds)}"
    if place.model is not None:
        names = list(place.model.model_fields)
        others = len(names) - KEYS_SHOWN
        more = f" and {others} others (napf-mpc problems --schema)" if others > 0 else ""
        return f"a table with the keys {', '.join(names[:KEYS_SHOWN])}{more}"
    return ""


def _list_noun(place: _Place) -> str:
    args = get_args(place.annotation)
    entry = place.entry(0)
    count = _length(place, "entries") if args[-1] is Ellipsis else f"{len(args)} entries"
    return f"a list of {count}, each {_noun(entry)}"
