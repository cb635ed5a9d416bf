"""Notebooks run from a fresh kernel, hold no algorithm, and are kept without outputs."""

import ast
import json
import sys
from pathlib import Path

import jupytext
import pytest
from jupyter_client.kernelspec import KernelSpecManager
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted([*FOLDER.glob("*.py"), *FOLDER.glob("*.ipynb")])
LESSONS = {"03_own_constraint.py": ("Ground", 15)}
"""Notebook whose subject is how to write a class -> that class, and its lines at most."""
every = pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.name)


def test_there_are_notebooks() -> None:
    assert "01_paper" in {file.stem for file in NOTEBOOKS}


@every
def test_it_starts_with_a_title_asks_questions_and_keeps_no_outputs(file: Path) -> None:
    cells = jupytext.read(file).cells
    assert cells[0].cell_type == "markdown"
    assert cells[0].source.startswith("# ")
    assert any(cell.source.startswith("## ") and "?" in cell.source for cell in cells)
    for cell in cells:
        if cell.cell_type == "code":
            assert not cell.get("outputs")
            assert cell.get("execution_count") is None


@every
def test_it_holds_no_algorithm(file: Path) -> None:
    for cell in jupytext.read(file).cells:
        if cell.cell_type == "code":
            plain = "\n".join(line for line in cell.source.splitlines() if not line.startswith("%"))
            tree = ast.parse(plain)
            name, most = LESSONS.get(file.name, ("", 0))
            for lesson in [node for node in tree.body if getattr(node, "name", None) == name]:
                assert lesson.end_lineno is not None
                assert lesson.end_lineno - lesson.lineno < most, f"{name} has more than {most} lines"
                tree.body.remove(lesson)
            for node in ast.walk(tree):
                assert not isinstance(node, (ast.FunctionDef, ast.ClassDef, ast.While, ast.Lambda)), (
                    f"{file.name}: move this into the library: {ast.unparse(node)}"
                )


@every
def test_it_runs(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NAPF_MPC_NOTEBOOK_RUNS", "20")
    monkeypatch.setenv("JUPYTER_RUNTIME_DIR", str(tmp_path / "runtime"))
    monkeypatch.setenv("JUPYTER_PLATFORM_DIRS", "1")
    # A kernel of this very interpreter, whatever kernels the machine has.
    spec = tmp_path / "kernels" / "python3"
    spec.mkdir(parents=True)
    launch = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    (spec / "kernel.json").write_text(
        json.dumps({"argv": launch, "display_name": "Python 3", "language": "python"})
    )
    kernels = KernelSpecManager(kernel_dirs=[str(tmp_path / "kernels")])
    notebook = jupytext.read(file)
    client = NotebookClient(
        notebook,
        km=AsyncKernelManager(kernel_name="python3", kernel_spec_manager=kernels),
        timeout=300,
        resources={"metadata": {"path": str(tmp_path)}},
    )
    client.execute(cleanup_kc=True)  # or the kernel of a manager of ours lives on, with its memory

    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not [output for output in outputs if output.get("name") == "stderr"]
