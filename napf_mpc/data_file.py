"""What is asked of any file before it is read: it is there, no folder, not packed, and not too big."""

from __future__ import annotations

from pathlib import Path

from napf_mpc.errors import DataError

__all__ = ["readable_file"]

_GZIP = b"\x1f\x8b\x08"


def readable_file(path: Path | str, max_bytes: int) -> Path:
    """Path of a file that can be read.

    Raises
    ------
    DataError
        It is missing, a folder, packed by gzip, or larger than ``max_bytes``.
    """
    path = Path(path)
    try:
        if not path.is_file():
            why = "is a folder; name a file in it" if path.is_dir() else "no such file"
            raise DataError(f"{path}: cannot be read: {why}")
        size = path.stat().st_size
        if size > max_bytes:
            raise DataError(f"{path}: {size} bytes, at most {max_bytes} are read; cut out what is needed")
        with path.open("rb") as file:
            packed = file.read(len(_GZIP)) == _GZIP
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    if packed:
        raise DataError(f"{path}: is packed by gzip; unpack it first")
    return path
