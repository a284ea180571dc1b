"""Conformance of trackers, and of changing their online settings in mid-episode."""

import json
import random
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np

from dynslam_bench.contracts import (
    Frame,
    Sequence,
    Tracker,
    TrackerContext,
    TrackerSpec,
    TrackResult,
    Trajectory,
)
from dynslam_bench.contracts.checks import Fault, blemishes, faults, trajectory_faults
from dynslam_bench.core import DynslamError
from dynslam_bench.core.settings import (
    Parameter,
    Settings,
    apply_overrides,
    build,
    online_parameters,
)
from dynslam_bench.evaluation import hints
from dynslam_bench.testing.report import (
    ConformanceError,
    ConformanceReport,
    NotApplicable,
    require,
    require_methods,
    require_unchanged,
)
from dynslam_bench.testing.scenes import CornerSequence, TurningSequence, hard_frames
from dynslam_bench.trackers.registry import TRACKERS, build_tracker, resolve_settings

Subject = TrackerSpec | str | Callable[[], Tracker]


def check_tracker(
    subject: Subject,
    *,
    settings: Settings | Mapping[str, Any] | None = None,
    sequence: Sequence | None = None,
    frames: int = 6,
    seed: int = 0,
) -> None:
    """Check that a tracker keeps its contract, on a small exact scene and on degenerate frames.

    Args:
        subject: A spec, an id, ``module:Attr``, ``file.py:Attr``, or a function that constructs a
            tracker.
        settings: Its settings, or overrides of the defaults by dotted name.
        sequence: What to track; the built-in scene by default.
        frames: How many frames to track in each check.
        seed: Seed of the randomness.

    Raises:
        ConformanceError: Names every failed check, the fault and the likely cause.
    """
    tracker_report(
        subject, settings=settings, sequence=sequence, frames=frames, seed=seed
    ).raise_for_failures()


def tracker_report(
    subject: Subject,
    *,
    settings: Settings | Mapping[str, Any] | None = None,
    sequence: Sequence | None = None,
    frames: int = 6,
    seed: int = 0,
    report: ConformanceReport | None = None,
) -> ConformanceReport:
    """Run all checks of `check_tracker` and report each.

    Args:
        subject: See `check_tracker`, as for all that follow but the last.
        settings: Overrides or settings.
        sequence: What to track.
        frames: How many frames to track in each check.
        seed: Seed of the randomness.
        report: The report to write into, which names the tracker then; a new one by default.

    Raises:
        PluginError: There is no such tracker.
    """
    report = ConformanceReport("") if report is None else report
    # a function that constructs trackers has no spec
    spec: TrackerSpec | None = None
    if isinstance(subject, str):
        spec = TRACKERS.get(subject)
    elif isinstance(subject, TrackerSpec):
        spec = subject
    # the report names the tracker before anything can fail
    report.subject = ConformanceReport.of("tracker", subject).subject
    if spec is not None:
        report.subject = f"tracker {spec.id!r}"
        report.run("spec", lambda: _spec(spec, settings))

    # what is tracked, and what the spec promises
    scene = CornerSequence(frames) if sequence is None else sequence
    run = _Runner(report, spec or subject, settings, scene, frames, seed)
    deterministic = spec is None or spec.deterministic
    monocular = spec is not None and spec.sensors == "rgb"

    def conventions() -> None:
        turning = TurningSequence()
        path = _Runner(report, spec or subject, settings, turning, len(turning), seed)
        _conventions(path, monocular)

    # a check for each kind of degenerate frame
    hard = {f"{name} frame": partial(_hard_frame, run, name) for name in hard_frames(scene[0])}
    return report.run_all(
        {"construction": lambda: _construction(run), "results": lambda: _results(run)},
        {
            "camera to world": conventions,
            "same stats on every frame": lambda: _same_keys(run),
            "frames are left alone": lambda: _frames_left_alone(run),
            "determinism": lambda: _determinism(run, deterministic),
            "two resets": lambda: _two_resets(run, deterministic),
            **hard,
            "one frame": lambda: _final(run, 1),
            "online settings": lambda: _online_settings(run, spec, settings),
            "final trajectory": lambda: _final(run),
            "closing": lambda: _closing(run),
        },
    )


class _Runner:
    """Tracks a scene, or variants of it, with fresh or given trackers.

    Args:
        report: Gets a sign of life with each frame.
        subject: A spec, or a function that constructs trackers.
        settings: Settings of the trackers that are constructed.
        scene: What to track.
        frames: How many of its frames.
        seed: Seed of the randomness.
    """

    def __init__(
        self,
        report: ConformanceReport,
        subject: Any,
        settings: Any,
        scene: Sequence,
        frames: int,
        seed: int,
    ) -> None:
        self.report = report
        self.subject = subject
        self.settings = settings
        self.scene = scene
        self.seed = seed
        self.frames = [scene[index] for index in range(min(frames, len(scene)))]

    def construct(self, settings: Settings | None = None) -> Any:
        """A tracker; with other settings than the subject's where they are given."""
        if not isinstance(self.subject, TrackerSpec):
            return self.subject()
        return build_tracker(
            self.subject,
            self.settings if settings is None else settings,
            TrackerContext(self.scene.id, self.scene.masks, fps=self.scene.fps),
        )

    def track(
        self, frames: list[Frame], tracker: Any = None, changed: Settings | None = None, at: int = 0
    ) -> list[TrackResult]:
        """Reset a tracker, track frames and check every result.

        Args:
            frames: What to track.
            tracker: The tracker; one that is not given is constructed, and closed at the end.
            changed: Settings to configure it to before one of the frames.
            at: Number of that frame.
        """
        # one episode, with one change of the settings at most
        used = self.construct() if tracker is None else tracker
        used.reset(self.scene.camera, rng=np.random.default_rng(self.seed))
        results = []
        poses = []  # copies, taken at once
        for number, frame in enumerate(frames):
            if changed is not None and number == at:
                used.configure(changed)
            results.append(used.track(frame))
            self.report.alive()
            check_result(results[-1], frame)
            poses.append(np.array(results[-1].T_world_cam))
        # a tracker without causal poses has those of its final trajectory
        if isinstance(self.subject, TrackerSpec) and not self.subject.online:
            results = _results_of(used.finalize(), frames)
            poses = [np.array(result.T_world_cam) for result in results]
        # no later frame may change a pose that was returned
        for frame, result, pose in zip(frames, results, poses, strict=True):
            require(
                result.T_world_cam is None or np.array_equal(result.T_world_cam, pose),
                f"the pose of frame {frame.index} changed later",
                "return a copy of the state, not the state",
            )
        if tracker is None:
            _close(used)
        return results


def _results_of(final: Trajectory, frames: list[Frame]) -> list[TrackResult]:
    """Results by the final trajectory, of a tracker without poses while it runs: a frame without one counts as lost."""
    poses = dict(zip(final.timestamps.tolist(), final.T_world_cam, strict=True))
    results = []
    for frame in frames:
        pose = poses.get(frame.timestamp)
        results.append(TrackResult(None, "lost") if pose is None else TrackResult(pose, "ok"))
    return results


def check_result(result: object, frame: Frame) -> None:
    """Check what a tracker gave for one frame.

    Raises:
        ConformanceError: It has a fault or a blemish, see `contracts.checks`.
    """
    where = f"frame {frame.index}: track() gave"
    _none_of(faults(result, frame), where)
    assert isinstance(result, TrackResult)
    _none_of(blemishes(result), where)


def _none_of(all_faults: Iterable[Fault], where: str) -> None:
    """Fail with the first of the faults; what is before it in the message is `where`."""
    for fault in all_faults:
        require(False, f"{where} {fault.found}", fault.cause)


def _spec(spec: TrackerSpec, settings: Settings | Mapping[str, Any] | None) -> None:
    """The spec names the tracker; its settings survive JSON, and presets and overrides fit them."""
    require(spec.id and spec.label, "the spec has no id or label")
    # settings are stored as JSON with every run
    default = spec.settings()
    require(
        build(spec.settings, json.loads(default.model_dump_json())) == default,
        "the default settings change when they are written as JSON and read again",
        "a field's type does not survive JSON",
    )
    # presets and overrides
    for name, overrides in spec.presets.items():
        try:
            apply_overrides(default, overrides)
        except Exception as error:
            raise ConformanceError(f"preset {name!r} does not fit the settings: {error}") from error
    if not isinstance(settings, Settings):
        resolve_settings(spec, settings)


def _construction(run: _Runner) -> None:
    """A tracker can be built, has the methods, and can be closed before it has tracked."""
    tracker = run.construct()
    require_methods(tracker, "reset", "track")
    _close(tracker)


def _results(run: _Runner) -> None:
    """Every result keeps the contract, and one frame at least is tracked."""
    states = [result.state for result in run.track(run.frames)]
    require(
        "ok" in states,
        f"no frame of an easy scene was tracked: {states}",
        "on this scene features abound and depth is exact",
    )


def _same_keys(run: _Runner) -> None:
    """The statistics have the same names on every frame."""
    results = run.track(run.frames)
    for frame, result in zip(run.frames, results, strict=True):
        changed = set(results[0].stats) ^ set(result.stats)
        require(
            not changed,
            f"frame {frame.index}: stats have other keys than on frame 0: {sorted(changed)}",
            "the keys must be the same on every frame; use 0 where there is no value",
        )


def _conventions(run: _Runner, monocular: bool) -> None:
    """Recognise world-to-camera poses, other axes and other units by the path of a camera that turns."""
    results = run.track(run.frames)
    count = len(run.frames)
    # stamps and poses of the frames that were tracked
    tracked = [
        (frame.timestamp, result.T_world_cam)
        for frame, result in zip(run.frames, results, strict=True)
        if result.state == "ok"
    ]
    if len(tracked) < count // 2:
        raise NotApplicable(
            f"only {len(tracked)} of the {count} frames of a camera that turns were tracked"
        )
    stamps = np.array([stamp for stamp, _ in tracked])
    poses = np.array([pose for _, pose in tracked])
    # the path beside the exact one: a wrong convention shows in the whole of it
    estimate = Trajectory(stamps, poses)
    truth = run.scene.ground_truth
    assert truth is not None
    # hints on the path as a whole; those on stamps and on noise are no conventions
    likely = hints(estimate, truth, "tum-rgbd/v1-sim3" if monocular else "tum-rgbd/v1")
    others = ("time-shift", "below-truth-noise")
    conventions = [hint.text for hint in likely if hint.id not in others]
    require(not conventions, "; ".join(conventions))


def _frames_left_alone(run: _Runner) -> None:
    """Tracking changes no image."""
    # earlier checks may have changed the others
    frames = [run.scene[frame.index] for frame in run.frames]
    require_unchanged(
        lambda: run.track(frames),
        *[image for frame in frames for image in (frame.rgb, frame.depth)],
        what="a frame",
    )


def _determinism(run: _Runner, deterministic: bool) -> None:
    """Two trackers with one seed give the same results, bit for bit."""
    if not deterministic:
        raise NotApplicable("the spec says that it is not deterministic")
    # two episodes under different global seeds
    episodes = []
    for seed in (1, 2):  # of the global generators, which a tracker must not use
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        episodes.append(run.track(run.frames))
    at = first_difference(*episodes)
    require(
        not at,
        f"two runs with one seed differ: {at}",
        "randomness that does not come from rng (numpy.random, random, cv2.theRNG), threads, or hashing order",
    )


def _two_resets(run: _Runner, deterministic: bool) -> None:
    """A tracker that has tracked something else gives the same results again after a reset."""
    tracker = run.construct()
    first = run.track(run.frames, tracker)
    # another sequence between the two: three mirrored frames
    mirrored = [
        Frame(f.index, f.timestamp, f.rgb[:, ::-1].copy(), f.depth[:, ::-1].copy())
        for f in run.frames[:3]
    ]
    run.track(mirrored, tracker)
    at = first_difference(first, run.track(run.frames, tracker))
    _close(tracker)
    require(
        not at or not deterministic,
        f"the same frames give other results after a second reset(): {at}",
        "reset() leaves something of the sequence before: map, last pose, motion model, generator",
    )


def _hard_frame(run: _Runner, name: str) -> None:
    """A degenerate frame, at the start or in the middle, raises nothing."""
    # before there is a map, and after
    positions = ((0, "the first frame"), (len(run.frames) // 2, "a frame in the middle"))
    for position, where in positions:
        frames = list(run.frames)
        frames[position] = hard_frames(frames[position])[name]
        try:
            run.track(frames)
        except ConformanceError:
            raise
        except Exception as error:
            raise ConformanceError(
                f"{name} as {where} raised {type(error).__name__}: {error} "
                "(likely cause: no features or no depth is taken for granted; say 'lost' instead)"
            ) from error


def _final(run: _Runner, count: int | None = None) -> None:
    """The final trajectory, after so many frames or all, is valid and has stamps of frames alone."""
    if count == 1 and isinstance(run.subject, TrackerSpec) and not run.subject.online:
        raise NotApplicable("a program for whole sequences may need more than one frame")
    tracker = run.construct()
    frames = run.frames[:count]
    run.track(frames, tracker)
    finalises = callable(getattr(tracker, "finalize", None))
    final = tracker.finalize() if finalises else None
    _close(tracker)
    if not finalises:
        raise NotApplicable("the tracker has no finalize()")
    # valid, and no stamp that no frame has
    _none_of(trajectory_faults(final), "finalize() gave")
    assert isinstance(final, Trajectory)
    wrong_stamps = set(final.timestamps.tolist()) - {frame.timestamp for frame in frames}
    require(
        not wrong_stamps,
        f"the final trajectory has {len(wrong_stamps)} stamps of no frame, e.g. {sorted(wrong_stamps)[:1]}",
        "stamps have to be those of the frames, unrounded",
    )


def _closing(run: _Runner) -> None:
    """A tracker can be closed, and closed again."""
    tracker = run.construct()
    if getattr(tracker, "close", None) is None:
        raise NotApplicable("the tracker has no close()")
    run.track(run.frames[:2], tracker)
    _close(tracker)
    _close(tracker)  # twice must do no harm


def _close(tracker: Tracker) -> None:
    """Close a tracker if it can be closed."""
    try:
        close = getattr(tracker, "close", None)
        if close is not None:
            close()
    except Exception as error:
        raise ConformanceError(
            f"close() of a {type(tracker).__name__} raised {type(error).__name__}: {error} "
            "(likely cause: it passes close() on to an object that has none)"
        ) from error


def _online_settings(
    run: _Runner, spec: TrackerSpec | None, settings: Settings | Mapping[str, Any] | None
) -> None:
    """Check the contract of `core.settings.Reconfigurable` on a tracker.

    An episode that is reconfigured before its first frame has to equal that of a tracker built with
    the same settings; the next episode, without reconfiguration, that of a fresh tracker. Where
    settings have an effect in the second half of an episode, changing them in its middle has to
    have one there. All online settings are moved to alternate ends.
    """
    if spec is None:
        raise NotApplicable("no spec names online settings")
    if not spec.deterministic:
        raise NotApplicable("it is not deterministic")
    # which settings may change while it tracks
    start = settings if isinstance(settings, Settings) else resolve_settings(spec, settings)
    online = online_parameters(start)
    if not online:
        raise NotApplicable("the tracker has no online settings")
    tracker = run.construct(start)
    names = ", ".join(parameter.name for parameter in online[:4])
    if len(online) > 4:
        names += ", ..."
    require(
        callable(getattr(tracker, "configure", None)),
        f"the tracker class {type(tracker).__name__} has no method configure(settings), but {names} is online",
        "implement configure (see core.settings.Reconfigurable), or declare the setting without online=True",
    )

    # an episode without a change, to compare with
    fresh = run.track(run.frames, tracker)
    half = len(run.frames) // 2
    has_effect = False
    late_effects = []  # of changes in mid-episode, where building with the values has a late effect
    # all online settings at alternate ends of their ranges, then at the other ones
    for first_end in (0, 1):
        ends = _alternate_ends(online, first_end)
        try:
            changed = apply_overrides(start, ends)
            built = run.track(run.frames, run.construct(changed))
        except DynslamError:
            continue  # the ends do not go together
        _check_reconfiguration(run, tracker, changed, ends, built, fresh)
        has_effect |= bool(first_difference(fresh, built))
        # they matter late in the episode: then a change in its middle must, too
        if first_difference(fresh[half:], built[half:]):
            reconfigured = run.track(run.frames, tracker, changed, half)
            late_effects.append(first_difference(fresh, reconfigured))
    require(
        any(late_effects) or not late_effects,
        f"configure() in mid-episode changes nothing, although building with {names} does",
        "the settings are read once; read them on every frame",
    )
    if not has_effect:
        raise NotApplicable(f"{names} change nothing on this scene, at either end of their ranges")


def _alternate_ends(online: list[Parameter], first_end: int) -> dict[str, Any]:
    """Each setting at the other end of its range, or of its choices, than the one before it.

    Args:
        online: The settings.
        first_end: The end of the first one: 0 for the low, 1 for the high end.
    """
    ends = {}
    for number, parameter in enumerate(online, first_end):
        values = parameter.choices or (parameter.low, parameter.high)
        ends[parameter.name] = values[-(number % 2)]
    return ends


def _check_reconfiguration(
    run: _Runner,
    tracker: Any,
    changed: Settings,
    ends: Mapping[str, Any],
    built: list[TrackResult],
    fresh: list[TrackResult],
) -> None:
    """A reconfigured episode equals that of a tracker built so; the next one that of a fresh tracker.

    Args:
        run: Tracks the scene.
        tracker: Built with other settings.
        changed: Settings to configure it to before the first frame.
        ends: What of them is changed, for messages.
        built: Results of a tracker built with them.
        fresh: Results of `tracker` before.
    """
    values = ", ".join(f"{name}={value}" for name, value in list(ends.items())[:4])
    at = first_difference(built, run.track(run.frames, tracker, changed))
    require(
        not at,
        f"configure() with {values} gives another result than building with it: {at}",
        "configure() does not reach the part that uses the setting, or only later",
    )
    at = first_difference(fresh, run.track(run.frames, tracker))
    require(
        not at,
        f"after an episode configured to {values}, reset() does not bring back the settings: {at}",
        "remember the settings that it was built with, and put them into force in reset()",
    )


def first_difference(first: list[TrackResult], second: list[TrackResult]) -> str:
    """The first difference of two episodes, bit for bit, for a message; empty if they are equal."""
    for index, (a, b) in enumerate(zip(first, second, strict=True)):
        if a.state != b.state:
            return f"frame {index}, states {a.state} and {b.state}"
        arrays = ("T_world_cam", "dynamic_mask", "keypoints_xy", "keypoints_keep")
        # names of the arrays that differ, then of the statistics
        different = [
            name for name in arrays if not np.array_equal(getattr(a, name), getattr(b, name))
        ]
        different += [key for key in {**a.stats, **b.stats} if a.stats.get(key) != b.stats.get(key)]
        if different:
            return f"frame {index}, {', '.join(different[:3])}"
    return ""
