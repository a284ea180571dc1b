import gc
import hashlib
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

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
LONGEST = (
    "tests/tuning/test_studies.py",
    "tests/gate/",
    "tests/sequences/test_depth_factor.py",
    "tests/runs/test_runs_many.py",
    "tests/reports/",
    "tests/trackers/",
)
"""Files that take minutes. With `--no-loadscope-reorder` they begin first, so that all workers end together."""


# What is imported and collected lives to the end: searching it for garbage takes a tenth of the time.
gc.disable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort files that take minutes to the beginning."""
    items.sort(key=lambda item: not item.nodeid.startswith(LONGEST))


def pytest_collection_finish() -> None:
    """Look for garbage from here on, in what the tests themselves make."""
    gc.freeze()
    gc.enable()


def pytest_configure(config: pytest.Config) -> None:
    """A test that is named by its id runs, slow or not."""
    if config.option.markexpr == "not slow" and any("::" in argument for argument in config.args):
        config.option.markexpr = ""


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the kernels once, on two cores: several workers would each compile all of them."""
    is_worker = hasattr(session.config, "workerinput")
    if is_worker or not getattr(session.config.option, "numprocesses", None):
        return
    gc.enable()  # the workers collect the tests, not this process
    # even where everything lies compiled, loading it takes 25 s of processor
    stamp = kernels_stamp()
    if stamp.exists():
        return
    for codes in KERNELS:
        processes = [subprocess.Popen([sys.executable, "-c", code]) for code in codes]
        exits = [process.wait() for process in processes]
        if any(exits):
            return  # the tests tell what is wrong
    stamp.parent.mkdir(parents=True, exist_ok=True)
    stamp.touch()


def kernels_stamp() -> Path:
    """A file in the cache of kernels: it is there when these sources, Python and numba have been compiled."""
    from dynslam_bench.core.folders import kernels_folder
    from dynslam_bench.core.module_graph import module_files

    sources = {file: file.read_bytes() for file in map(Path, module_files().values())}
    # kernels read the constants of modules beside them
    folders = {file.parent for file, text in sources.items() if b"core.compiled import" in text}
    state = hashlib.sha256(f"{sys.version} numba {version('numba')} {KERNELS}".encode())
    for file in sorted(sources):
        if file.parent in folders:
            state.update(sources[file])
    return kernels_folder() / f"tests-{state.hexdigest()[:16]}.compiled"


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
