"""Errors that a user can meet, each naming the thing, its value and the way out."""

from __future__ import annotations


class NapfError(Exception):
    """Base of every error that napf_mpc raises on purpose; the command line turns it into exit code 2."""


class ProblemError(NapfError, ValueError):
    """A problem file or a setting is not usable.

    Parameters
    ----------
    source : str
        File or object the problem came from.
    problems : list of str
        One line for each fault: key path, value, what is allowed.
    """

    def __init__(self, source: str, problems: list[str]) -> None:
        self.source = source
        self.problems = list(problems)
        super().__init__("\n".join(f"{source}: {line}" for line in self.problems))

    def __reduce__(self) -> tuple[type[ProblemError], tuple[str, list[str]]]:
        # It comes from workers as it was raised; by default only the text would go along.
        return type(self), (self.source, self.problems)


class DataError(NapfError, ValueError):
    """A data file (city, navigation log, result) is missing, unreadable or inconsistent."""


class NavigationError(NapfError, ValueError):
    """A planner is told what it cannot plan with: shapes that do not fit, or a time that goes back."""


class SceneError(NapfError, ValueError):
    """A scene cannot be built as asked, for example more obstacles than fit."""


class OutputError(NapfError, OSError):
    """An output folder cannot be written or holds something else."""
