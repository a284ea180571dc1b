"""Conformance of trackers."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from dynslam_bench.contracts import Frame, Sequence, Tracker, TrackerContext, TrackerSpec, TrackResult, Trajectory
from dynslam_bench.contracts.checks import Fault, blemishes, faults, trajectory_faults
from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.settings import Parameter, Reconfigurable, Settings, apply_overrides, build, online_parameters
from dynslam_bench.evaluation.hints import hints
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.testing.report import ConformanceError, ConformanceReport, NotApplicable, require, still_alive
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
    """Check that a tracker keeps its contract, on a small exact scene and on frames that hurt.

    Args:
        subject: A spec, an id, ``module:Attr``, ``file.py:Attr``, or a function that constructs a tracker.
        settings: Its settings, or overrides of the defaults by dotted name.
        sequence: What to track; the built-in scene by default.
        frames: How many frames to track in each check.
        seed: Seed of the randomness.

    Raises:
        ConformanceError: Names every failed check, what was found and the likely cause.
    """
    tracker_report(subject, settings=settings, sequence=sequence, frames=frames, seed=seed).raise_for_failures()


def tracker_report(
    subject: Subject,
    *,
    settings: Settings | Mapping[str, Any] | None = None,
    sequence: Sequence | None = None,
    frames: int = 6,
    seed: int = 0,
) -> ConformanceReport:
    """Run all checks of `check_tracker` and report each.

    Raises:
        PluginError: There is no such tracker.
    """
    spec = TRACKERS.get(subject) if isinstance(subject, str) else subject if isinstance(subject, TrackerSpec) else None
    report = ConformanceReport(f"tracker {spec.id!r}" if spec else f"tracker {getattr(subject, '__name__', subject)!r}")
    scene = sequence if sequence is not None else CornerSequence(frames)
    context = TrackerContext(scene.id, scene.masks, fps=scene.fps)
    if spec is not None:
        report.run("spec", lambda: _spec(spec, settings))
        construct: Callable[[], Tracker] = _Builder(spec, settings, context)
    else:
        assert callable(subject)
        construct = subject
    if not report.run("construction", lambda: _construct(construct)):
        return report
    run = _Runner(construct, scene, frames, seed)
    if not report.run("results", lambda: _results(run)):
        return report
    report.run("camera to world", lambda: _conventions(construct if spec is None else spec, settings, seed))
    report.run("same stats on every frame", lambda: _same_keys(run))
    report.run("frames are left alone", lambda: _frames_left_alone(run))
    report.run("results are kept", lambda: _results_are_kept(run))
    deterministic = spec is None or spec.deterministic
    report.run("determinism", lambda: _determinism(run, deterministic))
    report.run("two resets", lambda: _two_resets(run, deterministic))
    for name in hard_frames(scene[0]):
        report.run(f"{name} frame", lambda name=name: _hard_frame(run, name))  # type: ignore[misc]
    report.run("one frame", lambda: _one_frame(run))
    report.run("steering", lambda: _steering(run, spec, settings, context))
    report.run("final trajectory", lambda: _finalize(run))
    report.run("closing", lambda: _closing(run))
    return report


class _Builder:
    def __init__(
        self, spec: TrackerSpec, settings: Settings | Mapping[str, Any] | None, context: TrackerContext
    ) -> None:
        self.arguments = spec, settings, context

    def __call__(self) -> Tracker:
        return build_tracker(*self.arguments)


class _Runner:
    """Tracks the scene, or variants of it, with fresh or given trackers."""

    def __init__(self, construct: Callable[[], Tracker], scene: Sequence, frames: int, seed: int) -> None:
        self.construct, self.scene, self.seed = construct, scene, seed
        self.count = min(frames, len(scene))
        self.frames = [scene[index] for index in range(self.count)]

    def track(self, frames: list[Frame], tracker: Tracker | None = None, *, global_seed: int = 0) -> list[TrackResult]:
        """Reset a tracker and feed it frames, after seeding the generators that it must not use."""
        own = tracker is None
        tracker = self.construct() if tracker is None else tracker
        random.seed(global_seed)
        np.random.seed(global_seed)  # noqa: NPY002 - the legacy generator is what a tracker might use by mistake
        tracker.reset(self.scene.camera, rng=np.random.default_rng(self.seed))
        results = []
        for frame in frames:
            result = tracker.track(frame)
            check_result(result, frame)
            results.append(result)
        if own:
            _close(tracker)
        return results


def check_result(result: object, frame: Frame) -> None:
    """Check what a tracker gave for one frame.

    Raises:
        ConformanceError: It has a fault or a blemish, see `contracts.checks`.
    """
    still_alive()
    _none_of(faults(result, frame), f"frame {frame.index}: track() gave")
    assert isinstance(result, TrackResult)
    _none_of(blemishes(result), f"frame {frame.index}: track() gave")


def _none_of(found: Iterable[Fault], doing: str) -> None:
    for fault in found:
        require(False, f"{doing} {fault.found}", fault.cause)


def _spec(spec: TrackerSpec, settings: Settings | Mapping[str, Any] | None) -> None:
    require(spec.id and spec.label, "the spec has no id or label")
    default = spec.settings()
    copy = build(spec.settings, json.loads(default.model_dump_json()))
    changed = "the default settings change when they are written as JSON and read again"
    require(copy == default, changed, "a field's type does not survive JSON")
    for name, overrides in spec.presets.items():
        try:
            apply_overrides(default, overrides)
        except Exception as error:
            raise ConformanceError(f"preset {name!r} does not fit the settings: {error}") from error
    if not isinstance(settings, Settings):
        resolve_settings(spec, settings)


def _construct(construct: Callable[[], Tracker]) -> None:
    tracker = construct()
    missing = [name for name in ("reset", "track") if not callable(getattr(tracker, name, None))]
    require(not missing, f"a {type(tracker).__name__} lacks {', '.join(missing)}()")
    _close(tracker)


def _results(run: _Runner) -> None:
    results = run.track(run.frames)
    states = [result.state for result in results]
    cause = "on this scene features abound and depth is exact"
    require("ok" in states, f"no frame of an easy scene was tracked: {states}", cause)


def _same_keys(run: _Runner) -> None:
    results = run.track(run.frames)
    keys = set(results[0].stats)
    for frame, result in zip(run.frames, results, strict=True):
        changed = keys ^ set(result.stats)
        found = f"frame {frame.index}: stats have other keys than on frame 0: {sorted(changed)}"
        require(not changed, found, "the keys must be the same on every frame; use 0 where there is nothing to say")


def _conventions(subject: TrackerSpec | Callable[[], Tracker], settings: Any, seed: int) -> None:
    """Recognise world-to-camera poses, other axes and other units by the path of a camera that turns."""
    clip = TurningSequence()
    sim3 = isinstance(subject, TrackerSpec) and subject.sensors == "rgb"
    context = TrackerContext(clip.id, clip.masks, fps=clip.fps)
    construct = _Builder(subject, settings, context) if isinstance(subject, TrackerSpec) else subject
    run = _Runner(construct, clip, len(clip), seed)
    results = run.track(run.frames)
    posed = [(f.timestamp, r.T_world_cam) for f, r in zip(run.frames, results, strict=True) if r.state == "ok"]
    if len(posed) < len(clip) // 2:
        raise NotApplicable(f"only {len(posed)} of the {len(clip)} frames of a camera that turns were tracked")
    estimate = Trajectory(np.array([stamp for stamp, _ in posed]), np.array([pose for _, pose in posed]))
    assert clip.ground_truth is not None
    found = hints(estimate, clip.ground_truth, "tum-rgbd/v1-sim3" if sim3 else "tum-rgbd/v1")
    conventions = [hint for hint in found if hint.id not in ("time-shift", "below-truth-noise")]
    require(not conventions, "; ".join(hint.text for hint in conventions))


def _frames_left_alone(run: _Runner) -> None:
    frames = [run.scene[index] for index in range(run.count)]  # those of earlier checks may be spoilt already
    before = [(frame.rgb.copy(), frame.depth.copy()) for frame in frames]
    run.track(frames)
    for frame, (rgb, depth) in zip(frames, before, strict=True):
        same = np.array_equal(frame.rgb, rgb) and np.array_equal(frame.depth, depth)
        require(same, f"frame {frame.index} was changed by the tracker", "draw on a copy")


def _results_are_kept(run: _Runner) -> None:
    tracker = run.construct()
    tracker.reset(run.scene.camera, rng=np.random.default_rng(run.seed))
    given, copies = [], []
    for frame in run.frames:
        pose = tracker.track(frame).T_world_cam
        given.append(pose)
        copies.append(None if pose is None else pose.copy())
    _close(tracker)
    for index, (pose, copy) in enumerate(zip(given, copies, strict=True)):
        same = pose is None or copy is None or np.array_equal(pose, copy)
        require(same, f"the pose of frame {index} changed later", "return a copy of the state, not the state")


def _determinism(run: _Runner, deterministic: bool) -> None:
    if not deterministic:
        raise NotApplicable("the spec says that it is not deterministic")
    first, second = run.track(run.frames, global_seed=1), run.track(run.frames, global_seed=2)
    cause = "randomness that does not come from rng (numpy.random, random, cv2.theRNG), threads, or hashing order"
    _same(first, second, "two runs with one seed differ", cause)


def _two_resets(run: _Runner, deterministic: bool) -> None:
    tracker = run.construct()
    first = run.track(run.frames, tracker)
    other = [Frame(f.index, f.timestamp, f.rgb[:, ::-1].copy(), f.depth[:, ::-1].copy()) for f in run.frames[:3]]
    run.track(other, tracker)
    again = run.track(run.frames, tracker)
    _close(tracker)
    if deterministic:
        cause = "reset() leaves something of the sequence before: map, last pose, motion model, generator"
        _same(first, again, "the same frames give other results after a second reset()", cause)


def _hard_frame(run: _Runner, name: str) -> None:
    for position in (0, run.count // 2):
        frames = list(run.frames)
        frames[position] = hard_frames(frames[position])[name]
        try:
            run.track(frames)
        except ConformanceError:
            raise
        except Exception as error:
            where = "the first frame" if position == 0 else "a frame in the middle"
            raise ConformanceError(
                f"{name} as {where} raised {type(error).__name__}: {error} "
                "(likely cause: no features or no depth is taken for granted; say 'lost' instead)"
            ) from error


def _one_frame(run: _Runner) -> None:
    tracker = run.construct()
    run.track(run.frames[:1], tracker)
    if callable(finalize := getattr(tracker, "finalize", None)):
        _check_final(finalize(), run.frames[:1])
    _close(tracker)


def _steering(
    run: _Runner, spec: TrackerSpec | None, settings: Settings | Mapping[str, Any] | None, context: TrackerContext
) -> None:
    if spec is None or not spec.deterministic:
        raise NotApplicable("no spec says what may be steered" if spec is None else "it is not deterministic")
    start = settings if isinstance(settings, Settings) else resolve_settings(spec, settings)
    check_steering(lambda given: build_tracker(spec, given, context), start, run.scene.camera, run.frames, run.seed)


def _finalize(run: _Runner) -> None:
    tracker = run.construct()
    finalize = getattr(tracker, "finalize", None)
    if not callable(finalize):
        _close(tracker)
        raise NotApplicable("the tracker has no finalize()")
    run.track(run.frames, tracker)
    _check_final(finalize(), run.frames)
    _close(tracker)


def _check_final(final: object, frames: list[Frame]) -> None:
    _none_of(trajectory_faults(final), "finalize() gave")
    assert isinstance(final, Trajectory)
    foreign = set(final.timestamps.tolist()) - {frame.timestamp for frame in frames}
    found = f"the final trajectory has {len(foreign)} stamps of no frame, e.g. {sorted(foreign)[:1]}"
    require(not foreign, found, "stamps have to be those of the frames, unrounded")


def _closing(run: _Runner) -> None:
    tracker = run.construct()
    if not callable(getattr(tracker, "close", None)):
        raise NotApplicable("the tracker has no close()")
    run.track(run.frames[:2], tracker)
    _close(tracker)
    _close(tracker)  # twice must do no harm


def _close(tracker: Tracker) -> None:
    if callable(close := getattr(tracker, "close", None)):
        close()


def _same(first: list[TrackResult], second: list[TrackResult], found: str, cause: str) -> None:
    for index, (a, b) in enumerate(zip(first, second, strict=True)):
        poses = (a.T_world_cam is None and b.T_world_cam is None) or (
            a.T_world_cam is not None and b.T_world_cam is not None and np.array_equal(a.T_world_cam, b.T_world_cam)
        )
        different = [key for key in a.stats if a.stats[key] != b.stats.get(key)]
        same = poses and a.state == b.state and not different
        what = f"pose {'equal' if poses else 'different'}, states {a.state} and {b.state}, stats {different[:3]}"
        require(same, f"{found} at frame {index}: {what}", cause)


# Conformance of steering: online settings act as building with them does, and end with the episode.

FEW = 6
"""Up to so many online settings are steered one by one; more of them all at once, to alternate ends."""
Episode = list[TrackResult]


def check_steering(
    build: Callable[[Settings], Tracker], settings: Settings, camera: Camera, frames: Iterable[Frame], seed: int
) -> None:
    """Check the contract of `core.steering.Reconfigurable` on a tracker.

    Steered from before the first frame, an episode has to be that of a tracker built with the same settings; the one
    after it, unsteered, that of a fresh tracker. Where settings show in the second half of an episode, steering in
    its middle has to show there with one of them at least.

    Args:
        build: Constructs the tracker with settings.
        settings: The settings to start from.
        camera: Of the frames.
        frames: What to track.
        seed: Seed of the randomness.

    Raises:
        ConformanceError: It cannot be steered, does not obey, or does not forget.
        NotApplicable: It has no online settings, or they change nothing on these frames.
    """
    online = online_parameters(settings)
    if not online:
        raise NotApplicable("the tracker has no online settings")
    tracker = build(settings)
    names = ", ".join(parameter.name for parameter in online[:4]) + (", ..." if len(online) > 4 else "")
    found = f"marked online: {names}; but a {type(tracker).__name__} has no configure(settings)"
    require(isinstance(tracker, Reconfigurable), found, "implement it (see core.steering), or take online=True away")
    fresh = _episode(tracker, camera, frames, seed)
    half = len(frames) // 2
    shown = False
    late: list[Settings] = []
    for ends in _ends(online):
        changed = apply_overrides(settings, ends)
        try:
            static = _episode(build(changed), camera, frames, seed)
        except DynslamError:
            continue  # the ends do not go together
        steered = _episode(tracker, camera, frames, seed, changed)
        again = _episode(tracker, camera, frames, seed)
        what = ", ".join(f"{name}={value}" for name, value in list(ends.items())[:4])
        at = first_difference(static, steered)
        found = f"configure() with {what} gives another result than building with it: {at}"
        require(not at, found, "configure() does not reach the part that uses the setting, or only later")
        at = first_difference(fresh, again)
        require(
            not at,
            f"after an episode steered to {what}, reset() does not bring back the settings: {at}",
            "remember the settings that it was built with, and put them into force in reset()",
        )
        shown = shown or bool(first_difference(fresh, static))
        late += [changed] if first_difference(fresh[half:], static[half:]) else []
    obeyed = any(first_difference(fresh, _episode(tracker, camera, frames, seed, changed, at=half)) for changed in late)
    cause = "the settings are read once, at the start; read them on every frame"
    require(
        obeyed or not late, f"configure() in mid-episode changes nothing, although building with {names} does", cause
    )
    if not shown:
        raise NotApplicable(f"{names} change nothing on this scene, at either end of their ranges")


def _ends(online: Iterable[Parameter]) -> Iterator[dict[str, Any]]:
    pairs = [(p.name, (p.choices[0], p.choices[-1]) if p.choices else (p.low, p.high)) for p in online]
    if len(pairs) <= FEW:
        yield from ({name: end} for name, ends in pairs for end in ends)
    else:
        yield {name: ends[number % 2] for number, (name, ends) in enumerate(pairs)}
        yield {name: ends[1 - number % 2] for number, (name, ends) in enumerate(pairs)}


def _episode(
    tracker: Any, camera: Camera, frames: Iterable[Frame], seed: int, settings: Settings | None = None, at: int = 0
) -> Episode:
    tracker.reset(camera, rng=np.random.default_rng(seed))
    results = []
    for number, frame in enumerate(frames):
        if settings is not None and number == at:
            tracker.configure(settings)
        results.append(tracker.track(frame))
    return results


def first_difference(first: Episode, second: Episode) -> str:
    """The first thing in which two episodes differ, bit for bit, for a message; empty if in none."""
    for index, (a, b) in enumerate(zip(first, second, strict=True)):
        if a.state != b.state:
            return f"frame {index}, states {a.state} and {b.state}"
        arrays = ("T_world_cam", "dynamic_mask", "keypoints_xy", "keypoints_keep")
        different = [name for name in arrays if not np.array_equal(_array(a, name), _array(b, name))]
        different += [key for key in {**a.stats, **b.stats} if a.stats.get(key) != b.stats.get(key)]
        if different:
            return f"frame {index}, {', '.join(different[:3])}"
    return ""


def _array(result: TrackResult, name: str) -> Any:
    value = getattr(result, name)
    return np.zeros(0) if value is None else value
