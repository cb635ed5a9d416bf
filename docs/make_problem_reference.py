"""Write the key tables of docs/problem_files.md from the problem model, so that they cannot differ from it.

Run ``python docs/make_problem_reference.py`` after a change to ``napf_mpc/problem/``. What stands above the
mark in the file is written by hand and kept.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from napf_mpc.problem_file import problem_schema
from napf_mpc.words import shown_number, shown_value

FILE = Path(__file__).parent / "problem_files.md"
MARK = "<!-- Below this line: written by docs/make_problem_reference.py, do not edit. -->\n"
SECTIONS = ("vehicle", "formation", "mission", "world", "navigation", "planner", "simulation", "reference")
TAGS = ("kind", "shape")
UNITS = {
    "_kgm2": "kg m²",
    "_kg": "kg",
    "_mps2": "m/s²",
    "_mps": "m/s",
    "_m": "m",
    "_s": "s",
    "_hz": "Hz",
    "_deg": "°",
}
SUPERSCRIPT = str.maketrans("23456", "²³⁴⁵⁶")

Node = Mapping[str, Any]


def main() -> None:
    """Write the file anew."""
    FILE.write_text(current(FILE.read_text(encoding="utf-8")), encoding="utf-8")


def current(text: str) -> str:
    """Return the file as it should be: the part by hand, the mark, the tables."""
    by_hand = text.partition(MARK)[0]
    return by_hand + MARK + "\n" + "\n".join(tables(problem_schema()))


def tables(schema: Node) -> Iterator[str]:
    """Yield the lines of all tables."""
    definitions: Node = schema["$defs"]
    yield "## Top level"
    yield ""
    top = {key: node for key, node in schema["properties"].items() if key not in SECTIONS}
    yield from _table(top, schema["required"])
    for section in SECTIONS:
        node = schema["properties"][section]
        needed = " (required)" if section in schema["required"] else ""
        yield f"## `[{section}]`{needed}"
        yield ""
        yield from _section(node, section, definitions, "###")


def _section(node: Node, section: str, definitions: Node, heading: str) -> Iterator[str]:
    kinds = _kinds(node, definitions)
    told: list[Node] = []  # what every kind has is told once, below the first
    for model in kinds:
        properties: Node = model["properties"]
        tag = next((name for name in TAGS if "const" in properties.get(name, {})), None)
        if tag:
            default = " (default)" if "default" in properties[tag] else ""
            yield f'{heading} {section}: `{tag} = "{properties[tag]["const"]}"`{default}'
            yield ""
        yield _words(model["description"])
        yield ""
        yield from _table(
            {key: value for key, value in properties.items() if key != tag}, model.get("required", [])
        )
        for key, value in properties.items():
            if "items" in value and "oneOf" in value["items"] and value["items"] not in told:
                told.append(value["items"])
                yield from _section(value["items"], f"an entry of `{key}`", definitions, heading + "#")


def _kinds(node: Node, definitions: Node) -> list[Node]:
    """Give the models that a section may be."""
    if "oneOf" in node:
        return [_model(choice, definitions) for choice in node["oneOf"]]
    choices = [choice for choice in node.get("anyOf", [node]) if "$ref" in choice]
    return [_model(choice, definitions) for choice in choices]


def _model(node: Node, definitions: Node) -> Node:
    model: Node = definitions[node["$ref"].rpartition("/")[2]]
    return model


def _table(properties: Node, required: list[str]) -> Iterator[str]:
    if not properties:
        yield "No further keys."
        yield ""
        return
    yield "| key | unit | default | allowed | meaning |"
    yield "| --- | --- | --- | --- | --- |"
    for key, node in properties.items():
        words, unit = _unit(key, _words(node["description"]))
        default = "**required**" if key in required else _default(node.get("default"))
        yield f"| `{key}` | {unit} | {default} | {_allowed(node)} | {words} |"
    yield ""


def _words(text: str) -> str:
    return " ".join(text.replace("``", "`").replace("|", "\\|").split())


def _unit(key: str, words: str) -> tuple[str, str]:
    """Split a unit in brackets off the words; else the key's ending tells."""
    if found := re.search(r" \[([^\]]+)\]", words):
        unit = re.sub(r"\^(\d)", lambda power: power[1].translate(SUPERSCRIPT), found[1])
        return words.replace(found[0], "", 1), unit
    return words, next((unit for ending, unit in UNITS.items() if key.endswith(ending)), "")


def _default(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, list) and len(value) > 4 and len(set(value)) == 1:
        return f"{len(value)} times `{shown_value(value[0])}`"
    return f"`{shown_value(value)}`"


def _allowed(node: Node) -> str:
    if "anyOf" in node:
        return _allowed(next(choice for choice in node["anyOf"] if choice.get("type") != "null"))
    if "enum" in node:
        return ", ".join(f'`"{name}"`' for name in node["enum"])
    match node.get("type"):
        case "number" | "integer":
            return ("whole, " if node["type"] == "integer" else "") + _range(node)
        case "boolean":
            return "true, false"
        case "string":
            return f"text of {_count(node, 'Length')} characters"
        case "array" if "prefixItems" in node:
            items = node["prefixItems"]
            return f"{len(items)} entries, each {_allowed(items[0])}"
        case "array":
            items = node["items"]
            each = "a table (below)" if "oneOf" in items else _allowed(items)
            return f"list of {_count(node, 'Items')}, each {each}"
        case "object":
            names = ", ".join(f"`{name}`" for name in node["propertyNames"]["enum"])
            return f"table with keys out of {names}, each {_allowed(node['additionalProperties'])}"
    raise ValueError(f"no words for {node}")


def _range(node: Node) -> str:
    low = next((f"{sign} {shown_number(node[name])}" for name, sign in LOWER if name in node), "")
    high = next((f"{sign} {shown_number(node[name])}" for name, sign in UPPER if name in node), "")
    return ", ".join(bound for bound in (low, high) if bound) or "any"


LOWER = (("minimum", "≥"), ("exclusiveMinimum", ">"))
UPPER = (("maximum", "≤"), ("exclusiveMaximum", "<"))


def _count(node: Node, what: str) -> str:
    low, high = node.get(f"min{what}", 0), node.get(f"max{what}")
    return f"{low} or more" if high is None else f"{low} to {high}"


if __name__ == "__main__":
    main()
