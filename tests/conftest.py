import os

import pytest

# The tests start many interpreters, and each would compile the sources that it imports.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


@pytest.fixture(scope="session")
def toy_folder(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A toy sequence of 60 frames in TUM layout."""
    from envs_toys import write_folder  # loads OpenCV

    return str(write_folder(tmp_path_factory.mktemp("toys") / "toy", 60))
