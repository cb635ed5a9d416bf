"""What the README promises: its code runs, its commands exist, its tables agree with the code."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from napf_mpc.cli import app
from napf_mpc.shipped import shipped_problems

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)


def test_the_code_runs_and_does_what_its_comments_say(capsys: pytest.CaptureFixture[str]) -> None:
    namespace: dict[str, Any] = {}
    code, changes = re.subn(r"runs=(\d\d+|[2-9])\b", "runs=3", "\n".join(blocks(README, "python")))
    assert changes == 2  # both calls that fly many missions are cut short
    exec(compile(code, "README.md", "exec"), namespace)

    assert namespace["summary"]["planners"]["napf"]["runs"] == 3
    assert "napf: " in capsys.readouterr().out
    assert len(namespace["missions"].score.outcome) == 3
    velocity = namespace["command"].velocity[0]
    assert velocity[0, 1] > 0.5  # the sphere stands to the right of UAV 1's lane: away from it is left
    np.testing.assert_allclose(velocity[1:, 1:], 0.0, atol=1e-9)  # nobody else is near it


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_and_option_exists(page: Path) -> None:
    commands = dict(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
    kinds = commands.pop("benchmark").commands
    commands |= {f"benchmark {kind}": command for kind, command in kinds.items()}
    known = {
        name: {option for parameter in command.params for option in parameter.opts}
        for name, command in commands.items()
    }
    text = page.read_text(encoding="utf-8")
    if page.name == "README.md":
        words = r"(benchmark [a-z]+|[a-z]+)"
        table = set(re.findall(rf"^\| `{words}[ `]", text.partition("## Commands")[2], flags=re.MULTILINE))
        assert known.keys() <= table
    used = re.findall(r"napf-mpc (benchmark [a-z]+|[a-z]+)([^`\n&#]*)", text)
    if page.name == "README.md":
        used += re.findall(
            r"^\| `(run|validate|compare|montecarlo|figures|benchmark [a-z]+)( [^`]*)`",
            text,
            flags=re.MULTILINE,
        )
        assert len(used) > 6
    for name, rest in used:
        assert name in known, f"{page.name}: there is no command {name}"
        unknown = set(re.findall(r"(?<!\S)\[?(--[a-z-]+)", rest)) - known[name]
        assert not unknown, f"{page.name}: napf-mpc {name} has no {sorted(unknown)}"


def test_the_main_job_flies_a_shipped_problem() -> None:
    (command,) = (block for block in blocks(README, "bash") if "compare" in block)
    assert command.count("\n") == 1  # one line to copy
    assert re.search(r"napf-mpc compare (\w+) ", command)[1] in shipped_problems()  # type: ignore[index]


def test_no_two_commands_of_the_readme_write_into_one_folder() -> None:
    """A folder with another campaign's results is refused."""
    folders = re.findall(r"napf-mpc (?:run|compare|montecarlo|sweep|rare) [^`]*?--out (\w+)", README)
    assert len(folders) >= 3
    assert len(set(folders)) == len(folders), folders


def test_every_shipped_problem_is_in_the_table() -> None:
    table = README.partition("## Problem files")[2].partition("## Limits")[0]
    assert set(re.findall(r"`([a-z0-9]+_[a-z0-9_]+)`", table)) == set(shipped_problems())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if re.match(r"https?:", target):
            continue
        file, _, anchor = target.partition("#")
        path = (page.parent / file).resolve() if file else page
        assert path.exists(), f"{page.name}: {target}"
        if anchor:
            headings = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
            slugs = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
            assert anchor in slugs, f"{page.name}: {target}"


def test_the_picture_is_small() -> None:
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", README)
    assert pictures
    for picture in pictures:
        assert (ROOT / picture).stat().st_size < 300_000


@pytest.mark.skipif(os.name != "posix", reason="a shell script")
def test_ci_reads_its_command_from_the_readme() -> None:
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    extract = re.search(r"^command=\$\((.+)\)$", script, flags=re.MULTILINE)
    assert extract
    found = subprocess.run(["bash", "-c", extract[1]], cwd=ROOT, capture_output=True, text=True, check=True)
    (checks,) = (block for block in blocks(README, "bash") if "pytest" in block)
    assert found.stdout == checks
    assert os.access(ROOT / ".ci" / "run", os.X_OK)


def test_importing_the_library_prints_nothing_and_loads_nothing_heavy() -> None:
    heavy = {"numba", "casadi", "matplotlib", "scipy", "pyarrow", "shapely"}
    code = f"import sys, napf_mpc; print(sorted({heavy} & set(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (found.stdout, found.stderr) == ("[]\n", "")


def test_the_command_is_a_module_too() -> None:
    found = subprocess.run(
        [sys.executable, "-m", "napf_mpc", "problems"], capture_output=True, text=True, check=True
    )
    assert [line.split()[0] for line in found.stdout.splitlines()] == list(shipped_problems())
