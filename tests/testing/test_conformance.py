"""Conformance checks: what comes with the package passes, each fault is named, and they are tests of pytest."""

import re
import subprocess
import sys
from dataclasses import dataclass, replace
from importlib import metadata
from importlib.metadata import entry_points
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from helpers import hostile
from helpers.culling_rules import RULES

from dynslam_bench.contracts import FilterResult, FlowResult, Instances, Keypoints, TrackResult
from dynslam_bench.core import WEIGHTS_VARIABLE, PluginError
from dynslam_bench.core.plugins import ISOLATED_VARIABLE
from dynslam_bench.core.settings import Settings, tunable
from dynslam_bench.features.registry import build_extractor
from dynslam_bench.flow.registry import build_flow
from dynslam_bench.flow.settings import FlowSettings
from dynslam_bench.geometry import Trajectory, se3
from dynslam_bench.segmentation.build_segmenter import build_segmenter
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.sequences import open_sequence
from dynslam_bench.testing import (
    ConformanceError,
    CornerSequence,
    TurningSequence,
    check_features,
    check_filter,
    check_flow,
    check_segmenter,
    check_sequence,
    check_tracker,
    features_report,
    filter_scene,
    installation,
    isolated_tracker_report,
    tracker_report,
)
from dynslam_bench.testing.installation import examine
from dynslam_bench.testing.pytest_plugin import report_on
from dynslam_bench.trackers import TrackerSpec

SHARED = Path(__file__).resolve().parents[3] / "shared"


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(RULES))
def test_filters(name):
    check_filter(RULES[name])


def test_the_filter_scene_is_exact():
    """Undoing the flow of static points by the true motion leaves nothing; the panel's points move."""
    (before, _), (frame, state) = filter_scene(3)[1:3]
    moving = frame.instances.masks[0][tuple(np.rint(frame.xy).astype(int).T[::-1])]
    world = se3.transform(state.T_world_pred, state.camera.unproject(frame.xy, frame.z))
    expected = state.camera.project(se3.transform(se3.inverse(state.T_world_prev), world))
    error = np.linalg.norm(expected - state.flow.xy, axis=1)
    assert error[~moving & state.flow.valid].max() < 1e-3
    assert error[moving].min() > 5
    assert moving.sum() > 10
    column, row = np.rint(state.flow.xy).astype(int).T
    patch = frame.gray[
        np.rint(frame.xy[:, 1]).astype(int), np.rint(frame.xy[:, 0]).astype(int)
    ].astype(int)
    same = np.abs(before.gray[row.clip(0, 479), column.clip(0, 639)].astype(int) - patch)[
        state.flow.valid
    ]
    assert (same < 25).mean() > 0.8  # the images agree with the flow


@pytest.mark.slow
@pytest.mark.parametrize("name", ["never-move", "constant-velocity", "mask-rcnn"])
def test_trackers(name):
    check_tracker(
        name, frames=3, settings={"segmentation.source": "oracle"} if name == "mask-rcnn" else None
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "sequence", [CornerSequence(3), CornerSequence(1), "synthetic/sitting_rpy?scene=2&frames=5"]
)
def test_sequences(sequence):
    check_sequence(sequence)


@pytest.mark.skipif(not (SHARED / "data").is_dir(), reason="needs the excerpts in ../shared/data")
@pytest.mark.parametrize("name", ["bonn/crowd", "tum/fr1/xyz", "tum/fr1/rpy"])
def test_real_sequences(name):
    check_sequence(open_sequence(name, data_root=SHARED / "data", frames="3:", stride=2))


def test_segmenters():
    scene = CornerSequence(2)
    settings = SegmentationSettings(source="oracle")
    check_segmenter(lambda: build_segmenter(settings, sequence_id=scene.id, masks=scene.masks))


# Conformance checks of trackers that exit, hang, crash or leave processes behind: a verdict on
# every check.


def report_of(mode, target=hostile.TARGET, **options):
    return isolated_tracker_report(target, settings={"mode": mode}, frames=4, **options)


def failures(report):
    return {check.name: check.message for check in report.failed}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "check", "words"),
    [
        ("sys.exit", "results", "called sys.exit(0)"),
        ("os._exit", "results", "the process left with exit code 0 (likely cause: os._exit"),
        ("hang", "results", "no sign of life for 1 s (likely cause: an endless loop"),
        ("build-os._exit", "construction", "the process left with exit code 0"),
    ],
)
def test_a_tracker_that_ends_its_process_fails_the_check(mode, check, words):
    report = report_of(mode, frame_s=1.0)
    assert list(failures(report)) == [check]
    assert words in failures(report)[check]
    assert "\n" not in failures(report)[check]


@pytest.mark.slow
def test_the_other_checks_go_on():
    """It leaves the process on a black image only: that check fails, all others are made."""
    told = []
    report = report_of("ok", target=f"{hostile.__file__}:BLACK", on_check=told.append)
    assert list(failures(report)) == ["all-black frame"]
    assert told == report.checks
    assert len({check.name for check in told}) == len(told) >= 14
    assert report.checks[-1].name == "closing"
    assert report.subject == "tracker 'blackhater'"


def test_a_module_that_exits_when_it_is_loaded(tmp_path):
    (tmp_path / "leaver.py").write_text("import os\nos._exit(0)\n")
    report = report_of("ok", target=f"{tmp_path}/leaver.py:SPEC")
    assert list(failures(report)) == ["loading"]
    assert "exit code 0" in failures(report)["loading"]


def test_unknown_names_are_errors_and_no_verdicts():
    with pytest.raises(PluginError, match=r"unknown tracker 'orb-slam'.*orb-slam2"):
        isolated_tracker_report("orb-slam")
    assert (
        "unknown setting 'speed'"
        in failures(isolated_tracker_report("never-move", settings={"speed": 1}))["spec"]
    )


# Each check finds the fault that it is for, and names it.


TRUTH = CornerSequence(4).ground_truth.T_world_cam
TURNING = TurningSequence().ground_truth.T_world_cam


class Good:
    """Knows the scenes' poses by heart."""

    def reset(self, camera, *, rng):
        self.rng = rng
        self.stamps = []
        self.poses = TRUTH if camera.width == 640 else TURNING

    def track(self, frame):
        self.stamps.append(frame.timestamp)
        return TrackResult(self.poses[frame.index].copy(), "ok", {"matches": 1.0}, {"all": 0.001})

    def finalize(self):
        return Trajectory(np.array(self.stamps), TRUTH[: len(self.stamps)])

    def close(self):
        pass


def faulty(**methods):
    return type("Faulty", (Good,), methods)


def gave(change):
    return faulty(track=lambda self, frame: change(self, Good.track(self, frame), frame))


def reused_pose(self, frame):
    """One pose array for all results."""
    self.pose = vars(self).get("pose", np.eye(4))
    self.pose[:] = self.poses[frame.index]
    return TrackResult(self.pose, "ok")


@pytest.mark.slow
def test_a_good_tracker_passes():
    report = tracker_report(Good, frames=4)
    assert report.ok
    assert {c.status for c in report.checks if c.name != "online settings"} == {"passed"}
    assert len(report.checks) == 16


class Forgetful(Good):
    total = 0

    def track(self, frame):
        self.total += 1
        return TrackResult(self.poses[frame.index], "ok", {"total": float(self.total)})


SKEW = np.diag([1.1, 1, 1, 1])


def scribble(self, result, frame):
    frame.rgb[0, 0] = 77  # the same on every call: only fresh frames show it
    return result


@pytest.mark.parametrize(
    ("tracker", "check", "words"),
    [
        (gave(lambda s, r, f: r.T_world_cam), "results", "gave a ndarray, not a TrackResult"),
        (gave(lambda s, r, f: replace(r, state="fine")), "results", "gave state 'fine'"),
        (
            gave(lambda s, r, f: replace(r, T_world_cam=None)),
            "results",
            "state 'ok' without a pose",
        ),
        (
            gave(lambda s, r, f: replace(r, T_world_cam=r.T_world_cam * np.nan)),
            "results",
            "a solver diverged",
        ),
        (
            gave(lambda s, r, f: replace(r, T_world_cam=r.T_world_cam @ SKEW)),
            "results",
            "no rigid transformation",
        ),
        (
            gave(lambda s, r, f: replace(r, T_world_cam=r.T_world_cam[:3])),
            "results",
            r"shape \(3, 4\) as pose",
        ),
        (
            gave(lambda s, r, f: replace(r, T_world_cam=se3.inverse(r.T_world_cam))),
            "camera to world",
            "invert your",
        ),
        (
            gave(lambda s, r, f: replace(r, state="lost")),
            "results",
            "no frame of an easy scene was tracked",
        ),
        (
            gave(lambda s, r, f: replace(r, stats={f"n{f.index}": 1.0})),
            "same stats on every frame",
            "the same on every frame",
        ),
        (
            gave(lambda s, r, f: replace(r, stats={"n": float("nan")})),
            "results",
            "no finite numbers",
        ),
        (
            gave(lambda s, r, f: replace(r, timings={"t": -1.0})),
            "results",
            "a timing that is negative",
        ),
        (
            gave(lambda s, r, f: replace(r, dynamic_mask=np.zeros((4, 4), bool))),
            "results",
            "a dynamic mask of shape",
        ),
        (gave(scribble), "frames are left alone", "draw on a copy"),
        (faulty(track=reused_pose), "results", "the pose of frame 0 changed"),
        (
            gave(lambda s, r, f: replace(r, stats={"matches": float(np.random.rand())})),  # noqa: NPY002
            "determinism",
            "randomness that does not come from rng",
        ),
        (Forgetful, "two resets", "leaves something of the sequence before"),
        (
            faulty(finalize=lambda self: Trajectory(np.array([1.0]), np.eye(4)[None])),
            "final trajectory",
            "1 stamps of no frame",
        ),
        (faulty(finalize=lambda self: TRUTH), "final trajectory", "not a Trajectory"),
        (faulty(__init__=lambda self: 1 / 0), "construction", "raised ZeroDivisionError"),
        (faulty(track=None), "construction", r"lacks track\(\)"),
        (
            faulty(close=lambda self: self.inner.close()),
            "construction",
            r"close\(\) of a Faulty raised AttributeError",
        ),
    ],
)
def test_faulty_trackers(tracker, check, words):
    with pytest.raises(ConformanceError, match=words) as caught:
        check_tracker(tracker, frames=4)
    assert f"\n  {check}: " in str(caught.value)


@pytest.mark.parametrize(
    ("condition", "name"),
    [
        (lambda f: not f.rgb.any(), "all-black"),
        (lambda f: (f.rgb == 255).all(), "saturated"),
        (lambda f: f.rgb.any() and not f.depth.any(), "zero depth"),
        (lambda f: (f.rgb == 128).all(), "textureless"),
    ],
)
def test_trackers_that_break_on_hard_frames(condition, name):
    def track(self, frame):
        if condition(frame):
            raise IndexError("no features")
        return Good.track(self, frame)

    report = tracker_report(faulty(track=track), frames=4)
    assert [check.name for check in report.failed] == [f"{name} frame"]
    assert "raised IndexError: no features" in report.failed[0].message


def test_the_spec_is_checked_too(tmp_path):
    report = tracker_report(
        TrackerSpec("mine", f"{__name__}:Good", "Mine", presets={"fast": {"nothing": 1}}), frames=2
    )
    assert report.checks[0].status == "failed"
    assert "preset 'fast' does not fit" in report.checks[0].message


def unnamed_masks(sequence):
    """A sequence's masks without the names of their classes."""
    return [replace(CornerSequence(4).masks[i], class_names={}) for i in range(4)]


def frames(change):
    return {"__getitem__": lambda self, index: change(CornerSequence.__getitem__(self, index))}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"stamps": lambda stamps: stamps.astype(np.float32)}, "no float64 array"),
        ({"stamps": lambda stamps: stamps[::-1].copy()}, "not strictly increasing"),
        ({"stamps": lambda stamps: stamps * 1000}, "in seconds"),
        ({"truth": Trajectory(CornerSequence(4).timestamps + 1e6, TRUTH)}, "different clocks"),
        (
            {"__getitem__": lambda self, index: CornerSequence.__getitem__(self, min(index, 3))},
            "beyond the end",
        ),
        (frames(lambda f: replace(f, rgb=f.rgb[..., 0])), "the image is grey"),
        (frames(lambda f: replace(f, depth=f.depth * 5000)), "wrong depth_factor"),
        (
            frames(lambda f: replace(f, depth=np.where(f.depth > 2, np.float32("nan"), f.depth))),
            "missing depth is 0",
        ),
        (frames(lambda f: replace(f, index=0)), "says that its index is 0"),
        (
            frames(lambda f: replace(f, depth=f.depth + np.float32(np.random.rand()))),  # noqa: NPY002
            "differs when it is read",
        ),
        (
            {"masks": property(unnamed_masks)},
            "have no class name",
        ),
        (
            {"digest": lambda self: str(np.random.default_rng().random())},
            "two digests of one sequence differ",
        ),
    ],
)
def test_faulty_sequences(changes, words):
    sequence = type("Broken", (CornerSequence,), changes)(4)
    sequence.timestamps = changes.get("stamps", np.copy)(sequence.timestamps)
    sequence.ground_truth = changes.get("truth", sequence.ground_truth)
    with pytest.raises(ConformanceError, match=words):
        check_sequence(sequence)


class Keep:
    """Keeps everything."""

    needs = frozenset({"depth"})
    name = "keep"

    def reset(self, camera):
        pass

    def apply(self, frame, state):
        return FilterResult.of(np.ones(len(frame), bool))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"needs": frozenset({"magic"})}, "unknown needs"),
        (
            {"apply": lambda s, f, st: FilterResult.of(np.ones(3, bool))},
            "not only on those that earlier filters kept",
        ),
        (
            {
                "apply": lambda s, f, st: FilterResult(
                    np.ones(len(f), bool), np.full(len(f), 2, np.float32)
                )
            },
            "outside",
        ),
        ({"apply": lambda s, f, st: FilterResult.of(st.flow.valid)}, "raised AttributeError"),
        (
            {"apply": lambda s, f, st: FilterResult.of(f.z > f.z.min())},
            "no keypoints: raised ValueError",
        ),
        (
            {
                "apply": lambda s, f, st: replace(
                    FilterResult.of(np.ones(len(f), bool)), stats={f"n{f.index}": 1.0}
                )
            },
            "not declared",
        ),
        ({"stats_names": ("dropped", "tested")}, r"stats missing: \['tested'\]"),
        ({"stats_names": ()}, r"stats not declared: \['dropped'\]"),
        ({"apply": lambda s, f, st: FilterResult.of(np.random.rand(len(f)) > 0.5)}, "state.seed"),  # noqa: NPY002
    ],
)
def test_faulty_filters(change, words):
    check_filter(Keep)
    with pytest.raises(ConformanceError, match=words):
        check_filter(type("Faulty", (Keep,), change))


def instances(frame, **change):
    mask = np.zeros((1, *frame.depth.shape), bool)
    mask[0, 10:20, 30:60] = True
    return replace(
        Instances(
            mask, np.array([[30, 10, 60, 20]], np.float32), ("person",), np.ones(1, np.float32)
        ),
        **change,
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"masks": np.zeros((1, 9, 9), bool)}, "at the frame's resolution"),
        ({"boxes": np.array([[10, 30, 20, 60]], np.float32)}, "y before x"),
        ({"boxes": np.array([[30, 10, 25, 20]], np.float32)}, "not x, y, w, h"),
        ({"scores": np.array([3], np.float32)}, "logits, not scores"),
        ({"class_names": ("",)}, "a class has no name"),
    ],
)
def test_faulty_segmenters(change, words):
    check_segmenter(lambda: SimpleNamespace(segment=instances))
    with pytest.raises(ConformanceError, match=words):
        check_segmenter(lambda: SimpleNamespace(segment=lambda frame: instances(frame, **change)))


class Online(Settings):
    shift: float = tunable(0.0, low=0.0, high=1.0, online=True, meaning="added to a statistic")


class Configured(Good):
    """Obeys and forgets, as it should."""

    def __init__(self, settings):
        self.settings = self.built_with = settings

    def configure(self, settings):
        self.settings = settings

    def reset(self, camera, *, rng):
        super().reset(camera, rng=rng)
        self.settings = self.built_with

    def track(self, frame):
        return replace(super().track(frame), stats={"shift": self.settings.shift})


class Late(Configured):
    """Obeys one frame late."""

    def track(self, frame):
        before = self.seen if frame.index else self.built_with
        self.seen = self.settings
        return replace(Good.track(self, frame), stats={"shift": before.shift})


class Once(Configured):
    """Reads its settings on the first frame and never again."""

    def track(self, frame):
        self.seen = self.settings if frame.index == 0 else self.seen
        return replace(Good.track(self, frame), stats={"shift": self.seen.shift})


Fixed = type("Fixed", (Configured,), {"configure": None})
Deaf = type("Deaf", (Configured,), {"configure": lambda self, settings: None})
Leaky = type("Leaky", (Configured,), {"reset": Good.reset})
Inert = type("Inert", (Configured,), {"track": Good.track})


@pytest.mark.parametrize(
    ("tracker", "status", "words"),
    [
        (Configured, "passed", ""),
        (Fixed, "failed", "class Fixed has no method configure.settings., but shift is online"),
        (
            Deaf,
            "failed",
            "configure.. with shift=1.0 gives another result than building with it: frame 0, shift",
        ),
        (Leaky, "failed", "reset.. does not bring back the settings: frame 0, shift"),
        (
            Late,
            "failed",
            "configure.. with shift=1.0 gives another result than building with it: frame 0, shift",
        ),
        (
            Once,
            "failed",
            "configure.. in mid-episode changes nothing, although building with shift does",
        ),
        (Inert, "skipped", "shift change nothing on this scene"),
    ],
)
def test_online_settings_are_checked(tracker, status, words, monkeypatch):
    monkeypatch.setenv(ISOLATED_VARIABLE, "1")  # this file is no danger to the process
    spec = TrackerSpec("t", f"{__file__}:{tracker.__name__}", "T", settings=Online)
    (check,) = [c for c in tracker_report(spec, frames=4).checks if c.name == "online settings"]
    assert check.status == status, check
    assert re.search(words, check.message), check


# The checks as tests of pytest, and what they find in broken flows and feature extractors.


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


PLUGINS = [
    *("-p", "no:cacheprovider", "-p", "no:xdist"),
    *(
        []
        if entry_points(group="pytest11", name="dynslam-bench")
        else ["-p", "dynslam_bench.testing.pytest_plugin"]
    ),
]
"""Where the distribution is installed, pytest finds the plug-in by itself."""


def run_pytest(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pytest", "-v", *PLUGINS, *options, str(folder)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_each_check_of_a_plug_in_is_a_test(tmp_path: Path) -> None:
    (tmp_path / "still.py").write_text(FLOW)
    out = run_pytest(tmp_path, "--dynslam-flow", "still.py:SPEC").stdout
    assert re.search(r"still\.py:SPEC::determinism PASSED", out), out
    assert re.search(r"still\.py:SPEC::a small shift is found FAILED", out), out
    assert "xy are positions in the target, x first, not displacements" in out
    assert "1 failed" in out
    assert "INTERNALERROR" not in out


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
    assert {"protocol", "timestamps", "frames", "reading twice"} <= {
        check.name for check in report.checks
    }
    with pytest.raises(PluginError, match="the data set 'nothing' lists no sequence"):
        report_on("sequence", f"{tmp_path / 'corners.py'}:EMPTY")


@pytest.mark.slow
def test_an_unknown_subject_is_one_line(tmp_path: Path) -> None:
    ended = run_pytest(tmp_path, "--dynslam-flow", "dasiy")
    assert ended.returncode == 4
    assert "--dynslam-flow: unknown flow 'dasiy'" in ended.stderr + ended.stdout
    assert "Traceback" not in ended.stderr + ended.stdout


@pytest.mark.parametrize("method", ["lucas-kanade", "dis", "daisy"])
def test_the_built_in_flows_conform(method: str) -> None:
    check_flow(lambda: build_flow(FlowSettings(method=method)))


def test_the_built_in_extractor_conforms() -> None:
    report = features_report(build_extractor, descriptor_bytes=32)
    assert {check.status for check in report.checks} == {"passed"}, report.failed


@dataclass
class BadFlow:
    """Each fault by name."""

    fault: str

    def prepare(self, gray):
        prepared = gray.copy()
        gray[:] *= self.fault != "changes images"
        return prepared

    def track(self, reference, target, points, *, guess=None, seed=0):
        xy = points.copy()
        valid = np.isfinite(points).all(1) & (points >= 0).all(1) & (points < 600).all(1)
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


@dataclass
class BadFeatures:
    fault: str

    def extract(self, gray):
        corners = cv2.goodFeaturesToTrack(gray, 100, 0.01, 5)
        gray[:] *= self.fault != "changes images"
        xy = np.zeros((0, 2), np.float32) if corners is None else corners.reshape(-1, 2)
        count = len(xy)
        return Keypoints(
            xy + 1000 * (self.fault == "outside"),
            np.zeros(count, np.int64 if self.fault == "octave" else np.int32),
            np.full(count, -1 if self.fault == "radians" else 1, np.float32),
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


def test_missing_packages_extras_and_weights_are_named_with_a_way_to_get_them(
    monkeypatch, tmp_path
) -> None:
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
    assert findings["package", "numpy"].state == "1.2.3"
    assert not findings["package", "numpy"].missing
    assert findings["package", "pandas"].missing
    assert "pip install" in findings["package", "pandas"].hint
    assert (
        findings["extra", "gtsam"].hint == "pip install '.[gtsam]' in the checkout of dynslam-bench"
    )
    assert ("extra", "lint") not in findings
    coco = findings["weights", "coco"]
    assert coco.missing
    assert "https://" in coco.hint
    assert str(tmp_path) in coco.hint
    assert not findings["weights", "embedded"].missing
