"""What tests share. The data of `../shared` is not in the repository; tests that need it skip without it."""

import os
from pathlib import Path

import pytest

SHARED = Path(os.environ.get("FACERF_SHARED", Path(__file__).parents[2] / "shared"))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    if not (SHARED / "data").is_dir():
        pytest.skip(f"{SHARED / 'data'} is not here (set FACERF_SHARED)")
    return SHARED / "data"
