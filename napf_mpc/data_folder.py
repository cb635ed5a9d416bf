"""Where data files (cities, navigation logs) are found. They are never part of the package."""

from __future__ import annotations

import os
import re
from pathlib import Path

from napf_mpc.errors import DataError
from napf_mpc.words import shown_text

__all__ = ["DATA_VARIABLE", "find_data_file"]

DATA_VARIABLE = "NAPF_MPC_DATA"

# First part of a data file's path -> the public place that it comes from.
_PUBLIC_HOMES = {
    "city_tokyo_nishi_shinjuku": (
        "the buildings are made from the public repository indigo-lab/plateau-tokyo23ku-building-mvt-2020 "
        "(tiles z16, x 58197-58199, y 25803-25805; Project PLATEAU, MLIT Japan, CC BY 4.0)"
    ),
    "gnss_nagoya_spp": (
        "the GNSS log is in the public repository taroz/MatRTKLIB, folder examples/data/kinematic (MIT)"
    ),
    "gnss_berlin_smartloc": (
        "the pseudoranges are in the public repository TUC-ProAut/libRSF, folder datasets/smartLoc "
        "(Reisdorf, Pfeifer, Bressler, Bauer, Weissig, Lange, TU Chemnitz, CC BY-SA 4.0)"
    ),
    "px4_ulog_sample": (
        "the log is test/sample_log_small.ulg of the public repository PX4/pyulog (BSD-3-Clause)"
    ),
    "city_delft_cityjson": "the city is tests/data/delft.json of the public repository cityjson/cjio (MIT)",
}
_DRIVE = re.compile(r"[A-Za-z]:")


def find_data_file(name: str, data_folder: Path | None) -> Path:
    """Path of a data file that a problem names.

    Parameters
    ----------
    name : str
        Path under the data folder with forward slashes, for example ``"gnss_nagoya_spp/broadcast.nav"``.
        Problem files are data from anybody: a name that is absolute or leaves the folder, also through a
        symbolic link, is refused.
    data_folder : Path or None
        The data folder. None: the one that the variable ``NAPF_MPC_DATA`` names, else ``data`` in the
        current folder.

    Returns
    -------
    Path
        An existing regular file inside the data folder, symbolic links resolved.

    Raises
    ------
    DataError
        No such folder, no such file, or a name that is not allowed.
    """
    _refuse_escape(name)
    folder, origin = _folder(data_folder)
    way_out = f"give its folder with --data DIR or the variable {DATA_VARIABLE}"
    try:
        root = folder.resolve()
        path = (root / name).resolve()
        found = path.is_file()
        is_folder = path.is_dir()
    except (OSError, ValueError, RuntimeError) as error:  # too long a name, a loop of links
        reason = getattr(error, "strerror", None) or shown_text(str(error), 120)
        raise DataError(
            f'data file "{shown_text(name, 120)}" cannot be looked up in {folder}: {reason}'
        ) from error
    if not path.is_relative_to(root):
        raise DataError(
            f'data file "{shown_text(name, 120)}" leads out of the data folder {folder}: not allowed; '
            "copy it there"
        )
    if found:
        return path
    if is_folder:
        raise DataError(
            f'data file "{shown_text(name, 120)}" is a folder in {folder} ({origin}); name a file'
        )
    home = _PUBLIC_HOMES.get(name.split("/")[0])
    missing = "there is no such folder" if not folder.is_dir() else "it is not there"
    raise DataError(
        f'data file "{shown_text(name, 120)}" was looked for in {folder} ({origin}) but {missing}; {way_out}'
        + (f"; {home}" if home else "")
    )


def _refuse_escape(name: str) -> None:
    parts = name.replace("\\", "/").split("/")
    if not name.strip() or "\0" in name:
        raise DataError(
            f'data file "{shown_text(name, 120)}" is not a usable name; give a path under the data folder'
        )
    if parts[0] == "" or parts[0] == "~" or _DRIVE.match(name) or ".." in parts:
        raise DataError(
            f'data file "{shown_text(name, 120)}" must be a path under the data folder: not absolute, no ".."'
        )


def _folder(data_folder: Path | None) -> tuple[Path, str]:
    """Give the data folder and the words for where its name came from."""
    if data_folder is not None:
        if not Path(data_folder).is_dir():
            raise DataError(f"data folder {data_folder} (--data) is not a folder")
        return Path(data_folder), "--data"
    if named := os.environ.get(DATA_VARIABLE):
        return Path(named), f"variable {DATA_VARIABLE}"
    return Path("data"), "data in the current folder"
