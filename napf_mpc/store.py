"""Results on disk: Parquet and JSON, written whole or not at all. The one home of pyarrow."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from napf_mpc.errors import DataError, OutputError

Column = NDArray[Any] | Sequence[Any]
Columns = dict[str, NDArray[Any]]


@contextlib.contextmanager
def _replaced(path: Path) -> Iterator[IO[bytes]]:
    """Open a temporary file beside ``path`` that takes its place once it is whole and on the disk."""
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}; choose another --out") from error
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o644)
        os.replace(name, path)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written: {error.strerror}; earlier results are whole"
        ) from error
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name)


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
    text = json.dumps(value, indent=indent, allow_nan=False, ensure_ascii=False) + "\n"
    with _replaced(path) as file:
        file.write(text.encode())


def to_json(value: Any) -> str:
    """JSON text of plain data; numbers that are not finite are refused."""
    return json.dumps(value, allow_nan=False)


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


def write_table(path: Path, columns: Mapping[str, Column]) -> None:
    """Write columns of equal length as Parquet, whole or not at all; NaN becomes null."""
    arrays = {name: pa.array(values, from_pandas=True) for name, values in columns.items()}
    with _replaced(path) as file:
        pq.write_table(pa.table(arrays), file)


def read_table(path: Path) -> Columns:
    """Columns of a Parquet file of ours; null numbers become NaN.

    Raises
    ------
    DataError
        If it is missing or not Parquet.
    """
    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise DataError(f"{path}: not a readable Parquet file: {error}") from error
    return {name: _plain(table.column(name)) for name in table.column_names}


def _plain(column: Any) -> NDArray[Any]:
    values = column.to_numpy()
    return np.asarray(values, dtype=float) if values.dtype.kind == "f" else np.asarray(values)


def stack(tables: Sequence[Mapping[str, Column]]) -> Columns:
    """Tables with the same columns one under the other."""
    return {name: np.concatenate([np.asarray(table[name]) for table in tables]) for name in tables[0]}


def output_folder(path: Path) -> Path:
    """Make a folder for results.

    Raises
    ------
    OutputError
        If it cannot be made or is a file.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: cannot be used as output folder: {error.strerror}") from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise OutputError(f"{path}: is not writable; choose another --out")
    return path
