"""Results on disk: Parquet and JSON, written whole or not at all. The one home of pyarrow."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from napf_mpc.errors import DataError, OutputError

Column = NDArray[Any] | Sequence[Any]
Columns = dict[str, NDArray[Any]]

_LOCK = ".lock"
_PARTIAL = ".partial"


@contextlib.contextmanager
def _replaced(path: Path) -> Iterator[IO[bytes]]:
    """Open a temporary file beside ``path`` that takes its place once it is whole and on the disk."""
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}{_PARTIAL}")
    try:
        with partial.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
        _sync_folder(path.parent)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written: {error.strerror or error}; earlier results are whole; "
            "make room or choose another --out, then repeat the command"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Make a rename outlive a power cut, where the system can (Windows cannot open folders)."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def remove_partial(folder: Path) -> None:
    """Remove temporary files that a killed process has left behind; the caller holds the folder's lock."""
    for left in folder.glob(f".*{_PARTIAL}"):
        with contextlib.suppress(OSError):
            left.unlink()


def remove(path: Path) -> None:
    """Remove a file of ours.

    Raises
    ------
    OutputError
        If it cannot be removed.
    """
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be removed: {error.strerror or error}; choose another --out"
        ) from error


def write_bytes(path: Path, content: Callable[[IO[bytes]], object]) -> None:
    """Write a file through a callback, whole or not at all.

    Raises
    ------
    OutputError
        If the folder is read-only, the disk is full, or the path cannot be written.
    """
    with _replaced(path) as file:
        content(file)


def write_json(path: Path, value: Any, indent: int | None = 2) -> None:
    """Write JSON (no NaN: undefined values are null), whole or not at all."""
    text = to_json(value, indent) + "\n"
    with _replaced(path) as file:
        file.write(text.encode())


def to_json(value: Any, indent: int | None = None) -> str:
    """JSON text of plain data; a number that is not finite has no place in it."""
    return json.dumps(value, indent=indent, allow_nan=False, ensure_ascii=False)


def read_json(path: Path) -> Any:
    """Read a JSON file of ours.

    Raises
    ------
    DataError
        If it is missing or not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: not a readable JSON file: {error}") from error


def write_table(path: Path, columns: Mapping[str, Column], labels: Mapping[str, str] | None = None) -> None:
    """Write columns of equal length as Parquet, whole or not at all; NaN becomes null.

    Parameters
    ----------
    path : Path
        File to write.
    columns : mapping of str to array
        Name -> values.
    labels : mapping of str to str, optional
        Words about the table as a whole, see :func:`read_labels`.
    """
    with _replaced(path) as file:
        pq.write_table(_table(columns, labels), file, write_page_checksum=True)


def write_tables(path: Path, parts: Iterable[Mapping[str, Column]]) -> None:
    """Write tables with the same columns one under the other, one in memory at a time."""
    with _replaced(path) as file, contextlib.ExitStack() as stack:
        writer = None
        for part in parts:
            table = _table(part)
            if writer is None:
                writer = stack.enter_context(pq.ParquetWriter(file, table.schema, write_page_checksum=True))
            writer.write_table(table)


def _table(columns: Mapping[str, Column], labels: Mapping[str, str] | None = None) -> Any:
    arrays = {name: pa.array(values, from_pandas=True) for name, values in columns.items()}
    # A column without any value is one of text (``solver_status``), whatever other parts hold.
    arrays = {name: a.cast(pa.string()) if pa.types.is_null(a.type) else a for name, a in arrays.items()}
    return pa.table(arrays).replace_schema_metadata(dict(labels) if labels else None)


def read_table(path: Path) -> Columns:
    """Columns of a Parquet file of ours; null numbers become NaN.

    Raises
    ------
    DataError
        If it is missing, damaged or not Parquet.
    """
    with _reading(path), pq.ParquetFile(path, page_checksum_verification=True) as file:
        table = file.read()
        return {name: _plain(table.column(name)) for name in table.column_names}


def read_labels(path: Path) -> dict[str, str]:
    """Labels of a Parquet file of ours, without reading its rows.

    Raises
    ------
    DataError
        If it is missing or not Parquet.
    """
    with _reading(path), pq.ParquetFile(path) as file:
        labels = file.schema_arrow.metadata or {}
        return {key.decode(): value.decode() for key, value in labels.items()}


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
        reason = str(error).splitlines()[0] if str(error) else repr(error)
        raise DataError(f"{path}: not a readable Parquet file: {reason}") from error


def _plain(column: Any) -> NDArray[Any]:
    values = column.to_numpy()
    return np.asarray(values, dtype=float) if values.dtype.kind == "f" else np.asarray(values)


def stack(tables: Sequence[Mapping[str, Column]]) -> Columns:
    """Tables with the same columns one under the other; no table gives no columns."""
    if not tables:
        return {}
    return {name: np.concatenate([np.asarray(table[name]) for table in tables]) for name in tables[0]}


def output_folder(path: str | Path) -> Path:
    """Make a folder for results.

    Raises
    ------
    OutputError
        If it cannot be made, cannot be written or is a file.
    """
    try:
        path = Path(path)
        path.mkdir(parents=True, exist_ok=True)
    except TypeError as error:
        raise OutputError(f"out = {path!r}: is not the path of a folder") from error
    except FileExistsError as error:
        raise OutputError(f"{path}: is a file, not a folder; choose another --out") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = getattr(error, "strerror", None) or error
        raise OutputError(
            f"{path}: cannot be a folder for results: {reason}; choose another --out"
        ) from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise OutputError(f"{path}: is not writable; choose another --out")
    return path


def is_ours(entry: Path) -> bool:
    """Whether an entry of a folder is a trace of a process that was stopped before its first result."""
    return entry.name == _LOCK or (entry.name.startswith(".") and entry.name.endswith(_PARTIAL))


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other processes out of a folder; the lock goes with the process, however that ends.

    Raises
    ------
    OutputError
        If another process has it, or the lock cannot be written.
    """
    path = folder / _LOCK
    try:
        file = path.open("ab")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}; choose another --out") from error
    with file:
        if not _locked_now(file):
            raise OutputError(f"{folder}: is in use by another command; wait for it or choose another --out")
        yield


def _locked_now(file: IO[bytes]) -> bool:
    if sys.platform == "win32":
        return True  # two campaigns into one folder at a time go unnoticed there
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True  # a file system without locks
    return True
