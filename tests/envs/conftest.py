from __future__ import annotations

from pathlib import Path

import pytest
from envs_toys import write_folder

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


@pytest.fixture(scope="session")
def toy_folder(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A toy sequence of 60 frames in TUM layout."""
    return str(write_folder(tmp_path_factory.mktemp("toys") / "toy", 60))


@pytest.fixture(scope="session")
def real_data() -> str:
    if not (DATA / "tum").is_dir():
        pytest.skip("the real excerpts are not here")
    return str(DATA)
