"""Settings that every test shares."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

# The same examples on every machine: a failing example is then a fault of the code, never of the day.
settings.register_profile("reproducible", derandomize=True, deadline=None, max_examples=60)
settings.load_profile("reproducible")


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Folder with the real data; tests that need it are skipped by name when it is not there."""
    folder = os.environ.get("NAPF_MPC_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("real data not here: set NAPF_MPC_DATA to the data folder")
    return Path(folder)
