"""The problems that come with the package."""

from __future__ import annotations

from pathlib import Path

__all__ = ["shipped_problems"]


def shipped_problems() -> dict[str, Path]:
    """Name of every shipped problem and its file, sorted by name.

    Returns
    -------
    dict of str to Path
        Empty if the package was taken apart. An installed wheel carries the files in
        ``napf_mpc/_problems``; from a checkout they are in ``problems/`` beside the package.
    """
    package = Path(__file__).resolve().parent
    for folder in (package / "_problems", package.parent / "problems"):
        if folder.is_dir():
            return {path.stem: path for path in sorted(folder.glob("*.toml"))}
    return {}
