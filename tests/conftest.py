import os
import subprocess
import sys

import pytest

# The tests start many interpreters, and each would compile the sources that it imports.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# This one and its workers keep what they compile, too: collecting takes twice as long without.
sys.dont_write_bytecode = False
# They import the installed package, also from the checkout's folder.
os.environ["PYTHONSAFEPATH"] = "1"
# Their matrices are small: threads of OpenBLAS would only wait for each other.
os.environ["OPENBLAS_NUM_THREADS"] = "1"
TRACKER = "from dynslam_bench.cli.demo import compile_kernels; compile_kernels({!r})"
FLOWS = """
import numpy as np
from dynslam_bench.flow.registry import build_flow
from dynslam_bench.flow.settings import DenseFlowSettings, FlowSettings
rng = np.random.default_rng(0)
image, points = rng.integers(0, 256, (240, 320), np.uint8), rng.uniform(60, 180, (200, 2)).astype(np.float32)
for flow in map(build_flow, (FlowSettings(), DenseFlowSettings(terms=3))):
    flow.track(flow.prepare(image), flow.prepare(np.roll(image, 3, 1)), points)
"""
KERNELS = (
    (TRACKER.format("orb-slam2"), FLOWS),
    (TRACKER.format("emfoa-oft?masks=none"), TRACKER.format("dynaslam")),
)
"""What compiles the kernels in two rounds of two processes: rendering and SLAM, flow; then those that use both."""


def pytest_configure(config: pytest.Config) -> None:
    """A test that is named by its id runs, slow or not."""
    if config.option.markexpr == "not slow" and any("::" in argument for argument in config.args):
        config.option.markexpr = ""


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the kernels once, on two cores: several workers would each compile all of them."""
    if getattr(session.config.option, "numprocesses", None) and not hasattr(
        session.config, "workerinput"
    ):
        for codes in KERNELS:
            for process in [subprocess.Popen([sys.executable, "-c", code]) for code in codes]:
                process.wait()


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Ids of the records that are read whole."""
    from dynslam_bench.runs import RunStore

    ids: list[str] = []
    read_whole = RunStore.read_whole
    monkeypatch.setattr(
        RunStore, "read_whole", lambda self, run_id: ids.append(run_id) or read_whole(self, run_id)
    )
    return ids


@pytest.fixture(scope="session")
def toy_folder(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A toy sequence of 60 frames in TUM layout."""
    from helpers.envs_toys import write_folder  # loads OpenCV

    return str(write_folder(tmp_path_factory.mktemp("toys") / "toy", 60))
