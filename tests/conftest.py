import os
import subprocess
import sys

import pytest

# The tests start many interpreters, and each would compile the sources that it imports.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# They import the installed package, also from the checkout's folder; else the kernels compile twice.
os.environ["PYTHONSAFEPATH"] = "1"
COMPILING = pytest.StashKey[subprocess.Popen]()


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the kernels once, beside the first tests: several workers would each compile all of them."""
    if getattr(session.config.option, "numprocesses", None) and not hasattr(session.config, "workerinput"):
        code = "from dynslam_bench.cli.demo import compile_kernels; compile_kernels()"
        session.config.stash[COMPILING] = subprocess.Popen([sys.executable, "-c", code])


def pytest_sessionfinish(session: pytest.Session) -> None:
    if COMPILING in session.config.stash:
        session.config.stash[COMPILING].kill()


@pytest.fixture(scope="session")
def toy_folder(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A toy sequence of 60 frames in TUM layout."""
    from envs_toys import write_folder  # loads OpenCV

    return str(write_folder(tmp_path_factory.mktemp("toys") / "toy", 60))
