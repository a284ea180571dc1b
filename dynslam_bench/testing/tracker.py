"""Conformance of trackers, and of changing their online settings in mid-episode."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np

from dynslam_bench.contracts import Frame, Sequence, Tracker, TrackerContext, TrackerSpec, TrackResult, Trajectory
from dynslam_bench.contracts.checks import Fault, blemishes, faults, trajectory_faults
from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.settings import Parameter, Settings, apply_overrides, build, online_parameters
from dynslam_bench.evaluation.hints import hints
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.testing.report import (
    OBSERVER,
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
Results = list[TrackResult]
ONE_BY_ONE = 6
"""Up to so many online settings are changed one by one; more of them all at once, to alternate ends."""


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
        subject: A spec, an id, ``module:Attr``, ``file.py:Attr``, or a function that constructs a tracker.
        settings: Its settings, or overrides of the defaults by dotted name.
        sequence: What to track; the built-in scene by default.
        frames: How many frames to track in each check.
        seed: Seed of the randomness.

    Raises:
        ConformanceError: Names every failed check, the fault and the likely cause.
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
    report = ConformanceReport(f"tracker {spec.id!r}") if spec else ConformanceReport.of("tracker", subject)
    scene, turning = sequence if sequence is not None else CornerSequence(frames), TurningSequence()
    construct, construct_turning = (_constructor(spec or subject, settings, clip) for clip in (scene, turning))
    if spec is not None:
        report.run("spec", lambda: _spec(spec, settings))
    if not report.run("construction", lambda: _construction(construct)):
        return report
    run = _Runner(construct, scene, frames, seed)
    if not report.run("results", lambda: _results(run)):
        return report
    monocular = spec is not None and spec.sensors == "rgb"
    report.run("camera to world", lambda: _conventions(_Runner(construct_turning, turning, 24, seed), monocular))
    report.run("same stats on every frame", lambda: _same_keys(run))
    report.run("frames are left alone", lambda: _frames_left_alone(run))
    report.run("results are kept", lambda: _results_are_kept(run))
    deterministic = spec is None or spec.deterministic
    report.run("determinism", lambda: _determinism(run, deterministic))
    report.run("two resets", lambda: _two_resets(run, deterministic))
    for name in hard_frames(scene[0]):
        report.run(f"{name} frame", lambda name=name: _hard_frame(run, name))  # type: ignore[misc]
    report.run("one frame", lambda: _final(run, 1))
    report.run("online settings", lambda: _online_settings(run, spec, settings))
    report.run("final trajectory", lambda: _final(run))
    report.run("closing", lambda: _closing(run))
    return report


def _constructor(
    subject: TrackerSpec | Callable[[], Tracker] | str, settings: Any, clip: Sequence
) -> Callable[[], Tracker]:
    """What constructs the tracker for a sequence."""
    if isinstance(subject, TrackerSpec):
        return partial(build_tracker, subject, settings, TrackerContext(clip.id, clip.masks, fps=clip.fps))
    assert callable(subject)
    return subject


class _Runner:
    """Tracks the scene, or variants of it, with fresh or given trackers."""

    def __init__(self, construct: Callable[[], Tracker], scene: Sequence, frames: int, seed: int) -> None:
        self.construct, self.scene, self.seed = construct, scene, seed
        self.frames = [scene[index] for index in range(min(frames, len(scene)))]

    def track(self, frames: list[Frame], tracker: Tracker | None = None, *, global_seed: int = 0) -> Results:
        """Reset a tracker and feed it frames, after seeding the generators that it must not use."""
        random.seed(global_seed)
        np.random.seed(global_seed)  # noqa: NPY002 - the legacy generator is what a tracker might use by mistake
        used = self.construct() if tracker is None else tracker
        used.reset(self.scene.camera, rng=np.random.default_rng(self.seed))
        results = []
        for frame in frames:
            results.append(used.track(frame))
            check_result(results[-1], frame)
        if tracker is None:
            _close(used)
        return results


def check_result(result: object, frame: Frame) -> None:
    """Check what a tracker gave for one frame.

    Raises:
        ConformanceError: It has a fault or a blemish, see `contracts.checks`.
    """
    OBSERVER.get().alive()
    where = f"frame {frame.index}: track() gave"
    _none_of(faults(result, frame), where)
    assert isinstance(result, TrackResult)
    _none_of(blemishes(result), where)


def _none_of(all_faults: Iterable[Fault], where: str) -> None:
    for fault in all_faults:
        require(False, f"{where} {fault.found}", fault.cause)


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


def _construction(construct: Callable[[], Tracker]) -> None:
    tracker = construct()
    require_methods(tracker, "reset", "track")
    _close(tracker)


def _results(run: _Runner) -> None:
    states = [result.state for result in run.track(run.frames)]
    cause = "on this scene features abound and depth is exact"
    require("ok" in states, f"no frame of an easy scene was tracked: {states}", cause)


def _same_keys(run: _Runner) -> None:
    results = run.track(run.frames)
    for frame, result in zip(run.frames, results, strict=True):
        changed = set(results[0].stats) ^ set(result.stats)
        fault = f"frame {frame.index}: stats have other keys than on frame 0: {sorted(changed)}"
        require(not changed, fault, "the keys must be the same on every frame; use 0 where there is no value")


def _conventions(run: _Runner, monocular: bool) -> None:
    """Recognise world-to-camera poses, other axes and other units by the path of a camera that turns."""
    results, count = run.track(run.frames), len(run.frames)
    tracked = [(f.timestamp, r.T_world_cam) for f, r in zip(run.frames, results, strict=True) if r.state == "ok"]
    if len(tracked) < count // 2:
        raise NotApplicable(f"only {len(tracked)} of the {count} frames of a camera that turns were tracked")
    estimate = Trajectory(np.array([stamp for stamp, _ in tracked]), np.array([pose for _, pose in tracked]))
    truth = run.scene.ground_truth
    assert truth is not None
    likely = hints(estimate, truth, "tum-rgbd/v1-sim3" if monocular else "tum-rgbd/v1")
    conventions = [hint.text for hint in likely if hint.id not in ("time-shift", "below-truth-noise")]
    require(not conventions, "; ".join(conventions))


def _frames_left_alone(run: _Runner) -> None:
    frames = [run.scene[frame.index] for frame in run.frames]  # earlier checks may have changed the others
    images = [image for frame in frames for image in (frame.rgb, frame.depth)]
    require_unchanged(lambda: run.track(frames), *images, what="a frame")


def _results_are_kept(run: _Runner) -> None:
    tracker = run.construct()
    tracker.reset(run.scene.camera, rng=np.random.default_rng(run.seed))
    poses, copies = [], []
    for frame in run.frames:
        poses.append(tracker.track(frame).T_world_cam)
        copies.append(np.array(poses[-1]))
    _close(tracker)
    for index, (pose, copy) in enumerate(zip(poses, copies, strict=True)):
        same = pose is None or np.array_equal(pose, copy)
        require(same, f"the pose of frame {index} changed later", "return a copy of the state, not the state")


def _determinism(run: _Runner, deterministic: bool) -> None:
    if not deterministic:
        raise NotApplicable("the spec says that it is not deterministic")
    first, second = run.track(run.frames, global_seed=1), run.track(run.frames, global_seed=2)
    at = first_difference(first, second)
    cause = "randomness that does not come from rng (numpy.random, random, cv2.theRNG), threads, or hashing order"
    require(not at, f"two runs with one seed differ: {at}", cause)


def _two_resets(run: _Runner, deterministic: bool) -> None:
    tracker = run.construct()
    first = run.track(run.frames, tracker)
    mirrored = [Frame(f.index, f.timestamp, f.rgb[:, ::-1].copy(), f.depth[:, ::-1].copy()) for f in run.frames[:3]]
    run.track(mirrored, tracker)
    at = first_difference(first, run.track(run.frames, tracker))
    _close(tracker)
    cause = "reset() leaves something of the sequence before: map, last pose, motion model, generator"
    require(not at or not deterministic, f"the same frames give other results after a second reset(): {at}", cause)


def _hard_frame(run: _Runner, name: str) -> None:
    for position, where in ((0, "the first frame"), (len(run.frames) // 2, "a frame in the middle")):
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
    tracker, frames = run.construct(), run.frames[:count]
    run.track(frames, tracker)
    finalize = getattr(tracker, "finalize", None)
    final = finalize() if callable(finalize) else None
    _close(tracker)
    if not callable(finalize):
        raise NotApplicable("the tracker has no finalize()")
    _none_of(trajectory_faults(final), "finalize() gave")
    assert isinstance(final, Trajectory)
    foreign = set(final.timestamps.tolist()) - {frame.timestamp for frame in frames}
    fault = f"the final trajectory has {len(foreign)} stamps of no frame, e.g. {sorted(foreign)[:1]}"
    require(not foreign, fault, "stamps have to be those of the frames, unrounded")


def _closing(run: _Runner) -> None:
    tracker = run.construct()
    if getattr(tracker, "close", None) is None:
        raise NotApplicable("the tracker has no close()")
    run.track(run.frames[:2], tracker)
    _close(tracker)
    _close(tracker)  # twice must do no harm


def _close(tracker: Tracker) -> None:
    try:
        close = getattr(tracker, "close", None)
        if close is not None:
            close()
    except Exception as error:
        raise ConformanceError(
            f"close() of a {type(tracker).__name__} raised {type(error).__name__}: {error} "
            "(likely cause: it passes close() on to an object that has none)"
        ) from error


def _online_settings(run: _Runner, spec: TrackerSpec | None, settings: Settings | Mapping[str, Any] | None) -> None:
    if spec is None or not spec.deterministic:
        raise NotApplicable("no spec names online settings" if spec is None else "it is not deterministic")
    scene = run.scene
    context = TrackerContext(scene.id, scene.masks, fps=scene.fps)
    start = settings if isinstance(settings, Settings) else resolve_settings(spec, settings)
    check_online_settings(
        lambda changed: build_tracker(spec, changed, context), start, scene.camera, run.frames, run.seed
    )


def check_online_settings(
    build: Callable[[Settings], Tracker], settings: Settings, camera: Camera, frames: list[Frame], seed: int
) -> None:
    """Check the contract of `core.settings.Reconfigurable` on a tracker.

    An episode that is reconfigured before its first frame has to equal that of a tracker built with the same settings;
    the next episode, without reconfiguration, that of a fresh tracker. Where settings have an effect in the second half
    of an episode, changing them in its middle has to have one there, with one of them at least.

    Args:
        build: Constructs the tracker with settings.
        settings: The settings to start from.
        camera: Of the frames.
        frames: What to track.
        seed: Seed of the randomness.

    Raises:
        ConformanceError: It has no ``configure``, ignores it, or keeps its effect after ``reset``.
        NotApplicable: It has no online settings, or they change nothing on these frames.
    """
    online = online_parameters(settings)
    if not online:
        raise NotApplicable("the tracker has no online settings")
    tracker = build(settings)
    names = ", ".join(parameter.name for parameter in online[:4]) + (", ..." if len(online) > 4 else "")
    fault = f"the tracker class {type(tracker).__name__} has no method configure(settings), but {names} is online"
    cause = "implement configure (see core.settings.Reconfigurable), or declare the setting without online=True"
    require(callable(getattr(tracker, "configure", None)), fault, cause)
    fresh = _episode(tracker, camera, frames, seed)
    half = len(frames) // 2
    has_effect, late = False, list[Settings]()
    for ends in _ends(online):
        changed = apply_overrides(settings, ends)
        try:
            built = _episode(build(changed), camera, frames, seed)
        except DynslamError:
            continue  # the ends do not go together
        configured = _episode(tracker, camera, frames, seed, changed)
        again = _episode(tracker, camera, frames, seed)
        what = ", ".join(f"{name}={value}" for name, value in list(ends.items())[:4])
        at = first_difference(built, configured)
        fault = f"configure() with {what} gives another result than building with it: {at}"
        require(not at, fault, "configure() does not reach the part that uses the setting, or only later")
        at = first_difference(fresh, again)
        fault = f"after an episode configured to {what}, reset() does not bring back the settings: {at}"
        require(not at, fault, "remember the settings that it was built with, and put them into force in reset()")
        has_effect = has_effect or bool(first_difference(fresh, built))
        late += [changed] if first_difference(fresh[half:], built[half:]) else []
    obeyed = any(first_difference(fresh, _episode(tracker, camera, frames, seed, changed, at=half)) for changed in late)
    fault = f"configure() in mid-episode changes nothing, although building with {names} does"
    require(obeyed or not late, fault, "the settings are read once, at the start; read them on every frame")
    if not has_effect:
        raise NotApplicable(f"{names} change nothing on this scene, at either end of their ranges")


def _ends(online: list[Parameter]) -> Iterator[dict[str, Any]]:
    pairs = [(p.name, (p.choices[0], p.choices[-1]) if p.choices else (p.low, p.high)) for p in online]
    if len(pairs) <= ONE_BY_ONE:
        yield from ({name: end} for name, ends in pairs for end in ends)
    else:
        for first in (0, 1):
            yield {name: ends[(number + first) % 2] for number, (name, ends) in enumerate(pairs)}


def _episode(
    tracker: Any, camera: Camera, frames: list[Frame], seed: int, settings: Settings | None = None, at: int = 0
) -> Results:
    tracker.reset(camera, rng=np.random.default_rng(seed))
    results = []
    for number, frame in enumerate(frames):
        if settings is not None and number == at:
            tracker.configure(settings)
        results.append(tracker.track(frame))
    return results


def first_difference(first: Results, second: Results) -> str:
    """The first difference of two episodes, bit for bit, for a message; empty if they are equal."""
    for index, (a, b) in enumerate(zip(first, second, strict=True)):
        if a.state != b.state:
            return f"frame {index}, states {a.state} and {b.state}"
        arrays = ("T_world_cam", "dynamic_mask", "keypoints_xy", "keypoints_keep")
        different = [name for name in arrays if not np.array_equal(getattr(a, name), getattr(b, name))]
        different += [key for key in {**a.stats, **b.stats} if a.stats.get(key) != b.stats.get(key)]
        if different:
            return f"frame {index}, {', '.join(different[:3])}"
    return ""
