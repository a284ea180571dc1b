"""The conformance checks as tests of pytest, and what they find in broken flows and feature extractors."""

import re
import subprocess
import sys
from importlib import metadata
from importlib.metadata import entry_points
from pathlib import Path

import cv2
import numpy as np
import pytest

from dynslam_bench.contracts import FlowResult, Keypoints
from dynslam_bench.core import WEIGHTS_VARIABLE, PluginError
from dynslam_bench.features.registry import build_extractor
from dynslam_bench.flow.registry import build_flow
from dynslam_bench.flow.settings import FlowSettings
from dynslam_bench.testing import ConformanceError, check_features, check_flow, features_report, installation
from dynslam_bench.testing.installation import examine
from dynslam_bench.testing.pytest_plugin import report_on

FLOW = """
import numpy as np
from dynslam_bench.contracts import FlowResult, FlowSpec

class Still:
    def prepare(self, gray):
        return gray

    def track(self, reference, target, points, *, guess=None, seed=0):
        inside = (points >= 0).all(1) & (points < reference.shape[::-1]).all(1)
        return FlowResult(points.copy(), inside, np.zeros(len(points), np.float32))

def build(settings, *, device="cpu", threads=1):
    return Still()

SPEC = FlowSpec("still", f"{__file__}:build")
"""


INSTALLED = bool(entry_points(group="pytest11", name="dynslam-bench"))
"""Where the distribution is installed, pytest finds the plug-in by itself."""


def run_pytest(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pytest", "-v", "-p", "no:cacheprovider", "-p", "no:xdist", *options, str(folder)]
    command += [] if INSTALLED else ["-p", "dynslam_bench.testing.pytest_plugin"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_each_check_of_a_plug_in_is_a_test(tmp_path: Path) -> None:
    (tmp_path / "still.py").write_text(FLOW)
    out = run_pytest(tmp_path, "--dynslam-flow", "still.py:SPEC").stdout
    assert re.search(r"still\.py:SPEC::determinism PASSED", out), out
    assert re.search(r"still\.py:SPEC::a small shift is found FAILED", out), out
    assert "xy are positions in the target, x first, not displacements" in out
    assert "1 failed" in out and "INTERNALERROR" not in out


DATASET = """
from dynslam_bench.contracts import DatasetSpec
from dynslam_bench.testing import CornerSequence

def build(name, *, data_root):
    assert name == "corners/one"
    return CornerSequence(3)

SPEC = DatasetSpec("corners", f"{__file__}:build", ("corners/one",))
EMPTY = DatasetSpec("nothing", f"{__file__}:build")
"""


def test_a_data_set_is_checked_by_the_sequence_that_it_lists(tmp_path: Path) -> None:
    (tmp_path / "corners.py").write_text(DATASET)
    report = report_on("sequence", f"{tmp_path / 'corners.py'}:SPEC")
    assert {"protocol", "timestamps", "frames", "reading twice"} <= {check.name for check in report.checks}
    with pytest.raises(PluginError, match="the data set 'nothing' lists no sequence"):
        report_on("sequence", f"{tmp_path / 'corners.py'}:EMPTY")


def test_an_unknown_subject_is_one_line(tmp_path: Path) -> None:
    ended = run_pytest(tmp_path, "--dynslam-flow", "dasiy")
    assert ended.returncode == 4 and "--dynslam-flow: unknown flow 'dasiy'" in ended.stderr + ended.stdout
    assert "Traceback" not in ended.stderr + ended.stdout


@pytest.mark.parametrize("method", ["lucas-kanade", "dis", "daisy"])
def test_the_built_in_flows_conform(method: str) -> None:
    check_flow(lambda: build_flow(FlowSettings(method=method)))


def test_the_built_in_extractor_conforms() -> None:
    report = features_report(build_extractor, descriptor_bytes=32)
    assert {check.status for check in report.checks} == {"passed"}, report.failed


class BadFlow:
    """Each fault by name."""

    def __init__(self, fault: str) -> None:
        self.fault = fault

    def prepare(self, gray):
        prepared = gray.copy()
        gray[:] *= self.fault != "changes images"
        return prepared

    def track(self, reference, target, points, *, guess=None, seed=0):
        xy, valid = points.copy(), np.isfinite(points).all(1) & (points >= 0).all(1) & (points < 600).all(1)
        match self.fault:
            case "double":
                xy = xy.astype(np.float64)
            case "not finite":
                xy[:1] = np.nan
            case "valid outside":
                valid[:] = np.isfinite(xy).all(1)
            case "random":
                xy = xy + np.random.default_rng().normal(size=xy.shape).astype(np.float32)
        return FlowResult(xy, valid, np.zeros(len(points), np.float32))


@pytest.mark.parametrize(
    ("fault", "check"),
    [("double", "results"), ("not finite", "results"), ("valid outside", "points outside"),
     ("random", "determinism"), ("changes images", "images are left alone")],
)  # fmt: skip
def test_a_flow_that_breaks_the_contract_is_found(fault: str, check: str) -> None:
    with pytest.raises(ConformanceError, match=rf"\n  {check}: "):
        check_flow(lambda: BadFlow(fault))


class BadFeatures:
    def __init__(self, fault: str) -> None:
        self.fault = fault

    def extract(self, gray):
        corners = cv2.goodFeaturesToTrack(gray, 100, 0.01, 5)
        gray[:] *= self.fault != "changes images"
        xy = np.zeros((0, 2), np.float32) if corners is None else corners.reshape(-1, 2)
        count = len(xy)
        angle = np.full(count, -1 if self.fault == "radians" else 1, np.float32)
        octave = np.zeros(count, np.int64 if self.fault == "octave" else np.int32)
        return Keypoints(
            xy + 1000 * (self.fault == "outside"),
            octave,
            angle,
            np.ones(count, np.float32),
            np.zeros((count, 16 if self.fault == "short" else 32), np.uint8),
        )


@pytest.mark.parametrize(
    ("fault", "message"),
    [("outside", "lie outside the image"), ("radians", "degrees, not radians"), ("octave", "octave is int64"),
     ("short", "16 bytes, the spec says 32"), ("changes images", "was changed")],
)  # fmt: skip
def test_an_extractor_that_breaks_the_contract_is_found(fault: str, message: str) -> None:
    check_features(lambda: BadFeatures("none"), descriptor_bytes=32)
    with pytest.raises(ConformanceError, match=message):
        check_features(lambda: BadFeatures(fault), descriptor_bytes=32)


# What the program says is installed, and how to get what is not.


def test_missing_packages_extras_and_weights_are_named_with_a_way_to_get_them(monkeypatch, tmp_path) -> None:
    def version(name: str) -> str:
        if name in ("gtsam", "pandas"):
            raise metadata.PackageNotFoundError(name)
        return "1.2.3"

    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path))
    monkeypatch.setattr(installation.metadata, "version", version)
    monkeypatch.setattr(
        installation.metadata,
        "requires",
        lambda _: ["numpy>=1.26", "pandas>=2.0", "gtsam>=4.2; extra == 'gtsam'", "ruff; extra == 'lint'",
                   "tomli>=2; python_version < '3.11'"],
    )  # fmt: skip
    findings = {(finding.part, finding.name): finding for finding in examine()}
    assert findings["package", "numpy"].state == "1.2.3" and not findings["package", "numpy"].missing
    assert findings["package", "pandas"].missing and "pip install" in findings["package", "pandas"].hint
    assert findings["extra", "gtsam"].hint == "pip install '.[gtsam]' in the checkout of dynslam-bench"
    assert ("extra", "lint") not in findings
    coco = findings["weights", "coco"]
    assert coco.missing and "https://" in coco.hint and str(tmp_path) in coco.hint
    assert not findings["weights", "embedded"].missing
