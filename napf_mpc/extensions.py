"""Modules of the user's own that register planners and solvers, named on the command line."""

from __future__ import annotations

import sys
import traceback
from importlib import import_module
from pathlib import Path
from types import ModuleType

from napf_mpc.errors import NapfError, ProblemError
from napf_mpc.words import shown_text


def load_extension(where: str) -> None:
    """Import a module, so that what it registers can be named.

    Its folder is searched for modules from then on, as that of a script is, and by workers of a campaign on
    this machine, too.

    Parameters
    ----------
    where : str
        A file ``some/folder/mine.py``, or the name of a module, ``mine`` or ``package.mine``, that is
        installed or stands in the working directory.

    Raises
    ------
    ProblemError
        If there is no such module, another one has its name, or it cannot be imported.
    """
    path = Path(where)
    if path.suffix != ".py":
        folder, name = Path.cwd(), where
    elif path.is_file():
        folder, name = path.resolve().parent, path.stem
    else:
        raise _refused(where, "is not a file")
    if not all(part.isidentifier() for part in name.split(".")):
        raise _refused(where, "is not the name of a module; names have letters, digits and _ only")
    if str(folder) not in sys.path:
        # Behind all others: a file there must not take the place of a library's module.
        sys.path.append(str(folder))
    module = _imported(where, name)
    found = Path(getattr(module, "__file__", None) or "")
    if path.suffix == ".py" and found.resolve() != path.resolve():
        raise _refused(where, f"another module is named {name}: rename the file")


def _imported(where: str, name: str) -> ModuleType:
    try:
        return import_module(name)
    except NapfError as error:
        raise _refused(where, str(error)) from error
    except ModuleNotFoundError as error:
        if error.name is not None and f"{name}.".startswith(f"{error.name}."):
            raise _refused(where, "no such module is installed or in the working directory") from error
        raise _refused(where, _told(error)) from error
    except (Exception, SystemExit) as error:
        raise _refused(where, _told(error)) from error


def _told(error: BaseException) -> str:
    """What was raised, and in which line."""
    words = " ".join(f"{type(error).__name__}: {error}".split())
    if isinstance(error, SyntaxError):
        return f"cannot be imported: {shown_text(words, 200)}"
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"cannot be imported: {shown_text(words, 200)} ({Path(last.filename).name}:{last.lineno})"


def _refused(where: str, reason: str) -> ProblemError:
    return ProblemError(f"--with {shown_text(where, 120)}", [reason])
