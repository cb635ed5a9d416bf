"""Files appear whole or not at all, and damage is noticed."""

import errno
import os
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest

from napf_mpc import store
from napf_mpc.errors import DataError, OutputError


def table(rows: int = 4) -> dict[str, Any]:
    return {
        "planner": np.array(["apf"] * rows),
        "run": np.arange(rows),
        "hit": np.arange(rows) % 2 == 0,
        "finish_time_s": np.where(np.arange(rows) == 1, np.nan, 70.0 + np.arange(rows)),
        "solver_status": np.full(rows, None, dtype=object),
    }


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_a_table_comes_back_as_it_was(tmp_path: Path) -> None:
    store.write_table(tmp_path / "runs.parquet", table())
    back = store.read_table(tmp_path / "runs.parquet")
    assert back["run"].dtype == np.int64
    assert back["hit"].tolist() == [True, False, True, False]
    np.testing.assert_array_equal(back["finish_time_s"], [70.0, np.nan, 72.0, 73.0])
    assert back["solver_status"].tolist() == [None] * 4
    assert names(tmp_path) == ["runs.parquet"]


def test_undefined_values_are_null_for_other_readers(tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    store.write_table(tmp_path / "runs.parquet", table())
    column = pq.read_table(tmp_path / "runs.parquet").column("finish_time_s")
    assert column.null_count == 1
    assert column.to_pylist()[1] is None


def test_equal_tables_are_equal_files(tmp_path: Path) -> None:
    for name in ("a", "b"):
        store.write_table(tmp_path / name, table())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_labels_come_back_and_a_table_without_has_none(tmp_path: Path) -> None:
    store.write_table(tmp_path / "a.parquet", table(), {"first_run": "3", "campaign": '{"seed": 7}'})
    store.write_table(tmp_path / "b.parquet", table())
    assert store.read_labels(tmp_path / "a.parquet") == {"first_run": "3", "campaign": '{"seed": 7}'}
    assert store.read_labels(tmp_path / "b.parquet") == {}


def test_tables_are_written_one_under_the_other(tmp_path: Path) -> None:
    text = table(2) | {"solver_status": np.array(["solved", "solved"], dtype=object)}
    # The first part has no status at all: it must not decide the type of the column.
    store.write_tables(tmp_path / "t.parquet", iter([table(3), text]))
    back = store.read_table(tmp_path / "t.parquet")
    assert back["run"].tolist() == [0, 1, 2, 0, 1]
    assert back["solver_status"].tolist() == [None, None, None, "solved", "solved"]


def test_stack_of_nothing_has_no_columns() -> None:
    assert store.stack([]) == {}


def refuse_sync(handle: int) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


WRITERS: dict[str, Callable[[Path], None]] = {
    "table": lambda path: store.write_table(path, table()),
    "tables": lambda path: store.write_tables(path, [table(), table()]),
    "json": lambda path: store.write_json(path, {"runs": 3}),
    "bytes": lambda path: store.write_bytes(path, lambda file: file.write(b"new")),
}


@pytest.mark.parametrize("writer", WRITERS)
def test_a_full_disk_names_cause_and_path_and_leaves_the_old_file(
    writer: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "summary"
    path.write_bytes(b"old")
    monkeypatch.setattr(os, "fsync", refuse_sync)
    with pytest.raises(OutputError, match="No space left on device") as caught:
        WRITERS[writer](path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["summary"]


LIMITED = """
import resource, sys
from pathlib import Path
import numpy as np
from napf_mpc import store
from napf_mpc.errors import OutputError
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
path = Path(sys.argv[1])
try:
    store.write_table(path, {"x": np.random.default_rng(0).random(100_000)})
except OutputError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit on the size of files")
def test_a_write_that_fails_in_the_middle_of_a_table_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "runs.parquet"
    store.write_table(path, table())
    before = path.read_bytes()
    # The system itself refuses to let the file grow: the error comes up through the Parquet writer.
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(path)], capture_output=True, text=True, check=True
    )
    assert "runs.parquet: cannot be written" in done.stdout
    assert done.stderr == ""
    assert path.read_bytes() == before
    assert names(tmp_path) == ["runs.parquet"]


def test_an_interrupt_while_writing_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(b"old")

    def interrupted(file: IO[bytes]) -> None:
        file.write(b"half of it")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        store.write_bytes(path, interrupted)
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["a.json"]


def test_a_folder_that_vanished_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="No such file or directory"):
        store.write_json(tmp_path / "gone" / "a.json", {})


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no file modes")
def test_new_files_follow_the_users_mask(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        store.write_json(tmp_path / "a.json", {})
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.json").stat().st_mode) == 0o600


def test_a_number_that_is_not_finite_does_not_get_into_json(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        store.write_json(tmp_path / "a.json", {"risk": float("nan")})
    assert names(tmp_path) == []


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.9, 0.999])
def test_a_truncated_table_is_noticed(keep: float, tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    store.write_table(path, table(1000))
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(DataError, match=r"rows\.parquet: not a readable Parquet file"):
        store.read_table(path)


def test_one_flipped_bit_in_a_table_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    values = np.random.default_rng(1).random(1000)
    store.write_table(path, {"x": values})
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"rows\.parquet"):
        store.read_table(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    for read in (store.read_table, store.read_labels, store.read_json):
        with pytest.raises(DataError, match="missing"):
            read(tmp_path / "missing")


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, "\xff"])
def test_bad_json_is_one_error(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(text, encoding="latin-1")
    with pytest.raises(DataError, match=r"a\.json: not a readable JSON file"):
        store.read_json(tmp_path / "a.json")


def test_output_folder_is_made_with_its_parents(tmp_path: Path) -> None:
    assert store.output_folder(tmp_path / "a" / "b").is_dir()


def test_output_folder_refuses_what_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match="is a file, not a folder; choose another --out"):
        store.output_folder(tmp_path / "file")
    with pytest.raises(OutputError, match="choose another --out"):
        store.output_folder(tmp_path / "file" / "below")
    with pytest.raises(OutputError, match="choose another --out"):
        store.output_folder(tmp_path / ("x" * 300))
    with pytest.raises(OutputError, match="choose another --out"):
        store.output_folder(Path("nul\0byte"))
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(OutputError, match="is not writable; choose another --out"):
        store.output_folder(tmp_path)


@pytest.mark.skipif(sys.platform == "win32", reason="folders are not locked on Windows")
def test_a_folder_is_held_by_one_and_free_afterwards(tmp_path: Path) -> None:
    with store.locked(tmp_path):
        with pytest.raises(OutputError, match="is in use by another command"), store.locked(tmp_path):
            pass
        assert all(store.is_ours(entry) for entry in tmp_path.iterdir())
    with store.locked(tmp_path):
        pass


def test_leftovers_of_a_killed_process_go_and_nothing_else(tmp_path: Path) -> None:
    left = tmp_path / ".rows_00000000_00000004.parquet.0badcafe.partial"
    for path in (left, tmp_path / "notes.partial", tmp_path / ".hidden"):
        path.write_bytes(b"x")
    assert store.is_ours(left)
    assert not store.is_ours(tmp_path / "notes.partial")
    store.remove_partial(tmp_path)
    assert names(tmp_path) == [".hidden", "notes.partial"]
