"""Faults that hints find, and alarms on healthy trajectories (docs/evaluation.md, Hints).

    python tests/benchmarks/evaluation_hints.py [--frames 150] [--results DIR] [--verbose]

Estimates are the true paths of all rendered families with the errors of a good and of a poor tracker (nothing is
rendered), published trajectories where the shared data lie beside the checkout, and the runs of a results folder. Each
fault is made at several strengths from each estimate whose error is less than a fifth of its path's extent; a fault
counts as found if its hint is the only one. Time shifts and scales count that double the error at least.
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.evaluation import evaluate
from dynslam_bench.evaluation.hints import hints
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import FileNotes, load_tum, read_tum
from dynslam_bench.runs import RunStore
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.synthetic.ids import SYNTHETIC_IDS

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "trajectories"
FR3 = "rgbd-vo/rgbd_dataset_freiburg3_"
AUTHORS = {
    "lc_crf_slam/traject.txt": "authors/lc_crf_slam/groundtruth.txt",
    "amos_slam/CameraTrajectory.txt": "authors/amos_slam/groundtruth.txt",
    "dyslam/walking_xyz.txt": f"{FR3}walking_xyz/groundtruth.txt",
    "dyn_orb_slam/walking_xyz.txt": f"{FR3}walking_xyz/groundtruth.txt",
    "yolo_slam_ywl0720/walking_xyz.txt": f"{FR3}walking_xyz/groundtruth.txt",
    "yolo_dynaslam/walking_xyz.txt": f"{FR3}walking_xyz/groundtruth.txt",
    "cds_slam/walking_rpy.txt": f"{FR3}walking_rpy/groundtruth.txt",
    "ygc_slam/CameraTrajectory.txt": f"{FR3}walking_rpy/groundtruth.txt",
    "ddn_slam/fr3_long_office.txt": f"{FR3}long_office_household/groundtruth.txt",
}


@dataclass(frozen=True)
class Case:
    """An estimate, its truth, and what the file held in disorder."""

    group: str
    name: str
    estimate: Trajectory
    truth: Trajectory
    notes: FileNotes = field(default_factory=FileNotes)
    expected: str = ""


def tracked(truth: Trajectory, seed: int, drift: float, jitter_m: float) -> Trajectory:
    """A tracker's estimate: its errors accumulate from frame to frame, and each pose has some of its own."""
    rng = np.random.default_rng(seed)
    steps = se3.inverse(truth.T_world_cam[:-1]) @ truth.T_world_cam[1:]
    size = np.linalg.norm(se3.log(steps), axis=1, keepdims=True)
    steps = steps @ se3.exp(rng.normal(size=(len(steps), 6)) * (drift * size + 1e-4))
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ step)
    return Trajectory(truth.timestamps, np.array(poses) @ se3.exp(rng.normal(0, jitter_m, (len(truth), 6))))


def bad_trackers(truth: Trajectory, seed: int) -> Iterator[tuple[str, Trajectory]]:
    """Estimates that are wrong without any of the faults."""
    rng = np.random.default_rng(seed)
    stamps, good = truth.timestamps, tracked(truth, seed, 0.02, 5e-4).T_world_cam
    number = np.arange(len(stamps))
    yield "never moves", Trajectory(stamps, np.tile(np.eye(4), (len(stamps), 1, 1)))
    speed = se3.log(se3.inverse(good[:1]) @ good[min(5, len(good) - 1)][None]) / 5
    yield "constant velocity", Trajectory(stamps, se3.exp(speed * number[:, None]))
    yield "stands from the middle on", Trajectory(stamps, good[np.minimum(number, len(stamps) // 2)])
    yield "random walk", Trajectory(stamps, se3.exp(np.cumsum(rng.normal(0, 0.01, (len(stamps), 6)), axis=0)))
    jumps = se3.exp(rng.normal(0, 0.5, (4, 6)))[number * 4 // len(stamps)]
    yield "jumps", Trajectory(stamps, jumps @ good)
    yield "drifts", tracked(truth, seed, 0.3, 2e-3)
    lost = rng.random(len(stamps)) < 0.4
    yield "loses frames", Trajectory(stamps[~lost], good[~lost])
    people = np.tile(np.eye(4), (len(stamps), 1, 1))
    people[:, :3, 3] = 0.2 * np.sin(np.outer(number / 30, rng.uniform(0.5, 3, 3)) + rng.uniform(0, 6, 3))
    yield "follows people", Trajectory(stamps, people @ good)


def rendered(frames: int) -> Iterator[Case]:
    for number, name in enumerate(SYNTHETIC_IDS):
        truth = open_sequence(f"{name}@100?frames={frames}").ground_truth
        yield Case("rendered, good", name, tracked(truth, number, 0.01, 3e-4), truth)
        yield Case("rendered, poor", name, tracked(truth, number, 0.06, 2e-3), truth)
        for kind, estimate in bad_trackers(truth, number):
            yield Case("bad trackers", f"{name} {kind}", estimate, truth)


def published() -> Iterator[Case]:
    for file, truth in AUTHORS.items():
        read = load_tum(SHARED / "authors" / file)
        yield Case("authors' files", file, read.trajectory, read_tum(SHARED / truth), read.notes)
    for file in sorted(SHARED.glob("rgbd-vo/*/*.txt")):
        if file.name != "groundtruth.txt":
            read, truth = load_tum(file), read_tum(file.with_name("groundtruth.txt"))
            stamps = read.trajectory.timestamps
            several = ((stamps < truth.timestamps[0] - 20) | (stamps > truth.timestamps[-1] + 20)).any()
            expected = "several-recordings" if several else ""
            name = f"{file.parent.name}/{file.stem}"
            yield Case("rgbd-vo's files", name, read.trajectory, truth, read.notes, expected)
            if several:  # the rows of the one recording
                inside = (stamps > truth.timestamps[0]) & (stamps < truth.timestamps[-1])
                yield Case("rgbd-vo's, one recording", name, read.trajectory.select(inside), truth)


def stored(results: Path) -> Iterator[Case]:
    store = RunStore(results)
    for record in store.all()[0]:
        truth = store.ground_truth(record.sequence.part)
        for which in ("online", "final"):
            trajectory = store.trajectory(record.run_id, which)
            if truth is not None and trajectory is not None and record.tracker.sensors == "rgbd":
                name = f"{record.tracker.id} on {record.sequence.id} {which}"
                yield Case("runs", name, trajectory, truth)


def late(seconds: float) -> Callable[[Case], Case | None]:
    def fault(case: Case) -> Case | None:
        stamps = case.estimate.timestamps
        if abs(seconds) > 0.24 * (stamps[-1] - stamps[0]):
            return None
        return replace(case, estimate=Trajectory(stamps + seconds, case.estimate.T_world_cam))

    return fault


def posed(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Case], Case]:
    return lambda case: replace(case, estimate=Trajectory(case.estimate.timestamps, change(case.estimate.T_world_cam)))


def scaled(factor: float) -> Callable[[Case], Case]:
    def change(poses: np.ndarray) -> np.ndarray:
        poses = poses.copy()
        poses[:, :3, 3] *= factor
        return poses

    return posed(change)


def w_first(poses: np.ndarray) -> np.ndarray:
    position, quaternion = se3.to_quaternion(poses)
    return se3.from_quaternion(position, np.roll(quaternion, 1, axis=1))


def appended(seconds: float, rows: float) -> Callable[[Case], Case]:
    def fault(case: Case) -> Case:
        estimate = case.estimate
        count = max(2, int(rows * len(estimate)))
        other = estimate.select(slice(0, count))
        begin = estimate.timestamps[-1] + seconds if seconds > 0 else estimate.timestamps[0] + seconds - 100
        moved = Trajectory(other.timestamps - other.timestamps[0] + begin, other.T_world_cam)
        parts = [estimate, moved] if seconds > 0 else [moved, estimate]
        stamps = np.concatenate([part.timestamps for part in parts])
        return replace(case, estimate=Trajectory(stamps, np.concatenate([part.T_world_cam for part in parts])))

    return fault


def doubled(case: Case) -> Case | None:
    span = float(case.estimate.timestamps[-1] - case.estimate.timestamps[0])
    notes = FileNotes(2 * len(case.estimate), duplicates=len(case.estimate), out_of_order=1, back_s=span)
    return replace(case, notes=notes) if span > 10 else None


def copied(noise_m: float, between: float = 0.0) -> Callable[[Case], Case | None]:
    def fault(case: Case) -> Case | None:
        truth = case.truth
        measured = np.median(np.diff(truth.timestamps)) < 1 / 60
        inside = (case.estimate.timestamps > truth.timestamps[0]) & (case.estimate.timestamps < truth.timestamps[-2])
        stamps = case.estimate.timestamps[inside]
        if ((noise_m or between) and not measured) or len(stamps) < 40:
            return None
        at = np.searchsorted(truth.timestamps, stamps)
        poses = truth.T_world_cam[at].copy()
        if between:
            for axis in range(3):
                poses[:, axis, 3] = np.interp(stamps, truth.timestamps, truth.positions[:, axis])
        poses[:, :3, 3] += np.random.default_rng(0).normal(0, 1, (len(poses), 3)) * noise_m
        stamps = stamps if between else truth.timestamps[at]
        stamps, first = np.unique(stamps, return_index=True)
        poses = np.round(poses[first], 9)
        return replace(case, estimate=Trajectory(stamps, poses), notes=FileNotes())

    return fault


FAULTS: dict[str, dict[str, Callable[[Case], Case | None]]] = {
    "time-shift": {
        f"{s:+g} s": late(s) for s in (-1, -0.5, -0.2, -0.1, -0.05, -0.0333, 0.0333, 0.05, 0.1, 0.2, 0.5, 1)
    },
    "scale": {f"x {f:g}": scaled(f) for f in (1000, 100, 5, 1.5, 1.25, 0.8, 0.5, 0.2, 0.001)},
    "inverted-poses": {"": posed(se3.inverse)},
    "quaternion-order": {"": posed(w_first)},
    "several-recordings": {
        "15 s behind": appended(15, 1),
        "1 h behind": appended(3600, 0.3),
        "before": appended(-60, 0.5),
        "twice": doubled,
    },
    "below-truth-noise": {"copied": copied(0), "interpolated": copied(0, 1), "with 0.02 mm": copied(2e-5)},
}


def usable(case: Case) -> bool:
    try:
        metrics = evaluate(case.estimate, case.truth).metrics
    except DynslamError:
        return False
    return (
        metrics["ate_rmse_m"] < 0.2 * metrics["static_camera_ate_rmse_m"] and metrics["static_camera_ate_rmse_m"] > 0.01
    )


def harmful(made: Case, case: Case) -> bool:
    """Whether a fault doubles the error at least."""
    before, after = (evaluate(each.estimate, each.truth).metrics["ate_rmse_m"] for each in (case, made))
    return after > 2 * before


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--results", type=Path)
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    cases = list(rendered(options.frames))
    cases += list(published()) if SHARED.is_dir() else []
    cases += list(stored(options.results)) if options.results else []
    alarms: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0])
    spent, poses = 0.0, 0
    for case in cases:
        start = time.process_time()
        found = hints(case.estimate, case.truth, notes=case.notes)
        spent, poses = spent + time.process_time() - start, poses + len(case.estimate)
        named = {hint.id for hint in found}
        row = alarms[case.group]
        row[0] += 1
        row[1] += bool(case.expected) and case.expected in named
        false = named - {case.expected}
        row[2] += bool(false)
        if false and options.verbose:
            print(case.group, case.name, *(hint.text for hint in found), sep="\n    ")
    print("| trajectories | number | named rightly | false alarms |\n| --- | ---: | ---: | ---: |")
    for group, (count, right, false) in alarms.items():
        print(f"| {group} | {count} | {right or ''} | {false} |")
    print(f"\n{1e6 * spent / poses:.1f} us of processor time a pose\n")
    print("| fault | strength | made | found | beside others | named otherwise | not found |")
    print("| --- | --- | ---: | ---: | ---: | ---: | ---: |")
    sound = [case for case in cases if not case.expected and case.group != "bad trackers" and usable(case)]
    for fault, strengths in FAULTS.items():
        for strength, make in strengths.items():
            counts = defaultdict(int)
            for case in sound:
                if (made := make(case)) is None or (fault in ("time-shift", "scale") and not harmful(made, case)):
                    continue
                named = [hint.id for hint in hints(made.estimate, made.truth, notes=made.notes)]
                if fault not in named:
                    verdict = "otherwise" if named else "not"
                else:
                    verdict = "found" if named == [fault] else "beside"
                counts[verdict] += 1
                if verdict != "found" and options.verbose:
                    print("    ", fault, strength, case.group, case.name, named)
            total = sum(counts.values())
            numbers = " | ".join(str(counts[verdict]) for verdict in ("found", "beside", "otherwise", "not"))
            print(f"| {fault} | {strength} | {total} | {numbers} |")


if __name__ == "__main__":
    main()
