"""The documents name what exists: functions, tests, problem keys; their problem files are valid."""

import ast
import re
import runpy
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from napf_mpc.evaluate import METRICS, Outcome
from napf_mpc.problem_file import load_problem, problem_schema

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
EQUATIONS = (DOCS / "equations.md").read_text(encoding="utf-8")
NOT_IN_THE_TEXT = {"7", "16", "19"}


def rows() -> dict[str, list[list[str]]]:
    """Cells of the table rows by equation."""
    found: dict[str, list[list[str]]] = {}
    for line in EQUATIONS.splitlines():
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        if len(cells) == 5 and cells[0] not in ("Eq.", "---"):
            found.setdefault(cells[0], []).append(cells)
    return found


@pytest.mark.parametrize("page", sorted(DOCS.glob("*.md")), ids=lambda page: page.name)
def test_no_page_has_a_gap_to_be_filled_in(page: Path) -> None:
    assert "@@" not in page.read_text(encoding="utf-8")


def test_every_equation_has_a_function_and_a_test() -> None:
    table = rows()
    assert table.keys() == {str(number) for number in range(1, 40)} | {"3.2", "text"}
    for equation, lines in table.items():
        for _, printed, as_read, function, test in lines:
            assert printed
            assert as_read
            assert bool(function) == bool(test) == (equation not in NOT_IN_THE_TEXT), equation


@pytest.mark.parametrize("name", sorted(set(re.findall(r"`(napf_mpc(?:\.\w+)+)`", EQUATIONS))))
def test_functions_exist(name: str) -> None:
    """Follow the dotted name from the longest part that is a module."""
    parts = name.split(".")
    value: Any = None
    for i in range(1, len(parts) + 1):
        if value is None or not hasattr(value, parts[i - 1]):
            value = import_module(".".join(parts[:i]))
        else:
            value = getattr(value, parts[i - 1])
    assert value is not None


@pytest.mark.parametrize("name", sorted(set(re.findall(r"`(tests/[\w/.]+::\w+)`", EQUATIONS))))
def test_tests_exist(name: str) -> None:
    file, _, function = name.partition("::")
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    assert function in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_every_cell_with_a_test_is_checked() -> None:
    """A misspelt path would otherwise be no name at all and pass."""
    for lines in rows().values():
        for line in lines:
            for cell, pattern in ((line[3], r"napf_mpc(\.\w+)+"), (line[4], r"tests/[\w/]+\.py::test_\w+")):
                for name in re.findall(r"`([^`]+)`", cell):
                    assert re.fullmatch(pattern, name), name


def test_problem_reference_is_current() -> None:
    script = runpy.run_path(str(DOCS / "make_problem_reference.py"))
    text = script["FILE"].read_text(encoding="utf-8")
    assert script["current"](text) == text, "run python docs/make_problem_reference.py"


def test_every_key_is_in_the_reference() -> None:
    text = (DOCS / "problem_files.md").read_text(encoding="utf-8")
    for model in problem_schema()["$defs"].values():
        for key in model["properties"]:
            assert f"`{key}`" in text or f"`{key} = " in text


def test_every_metric_and_outcome_is_defined() -> None:
    text = (DOCS / "statistics.md").read_text(encoding="utf-8")
    assert [name for name in (*METRICS, *map(str, Outcome)) if f"`{name}`" not in text] == []


@pytest.mark.parametrize("page", sorted([*ROOT.glob("*.md"), *DOCS.glob("*.md")]), ids=lambda page: page.name)
def test_problems_in_the_documents_are_valid(page: Path, tmp_path: Path) -> None:
    for i, text in enumerate(
        re.findall(r"^```toml\n(.*?)^```$", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    ):
        file = tmp_path / f"{i}.toml"
        file.write_text(text, encoding="utf-8")
        assert load_problem(file).uav_count == 4
