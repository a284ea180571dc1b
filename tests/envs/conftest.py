from __future__ import annotations

import pytest
from envs_toys import write_folder


@pytest.fixture(scope="session")
def toy_folder(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A toy sequence of 60 frames in TUM layout."""
    return str(write_folder(tmp_path_factory.mktemp("toys") / "toy", 60))
