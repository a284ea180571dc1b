"""The factor on the back end's motion covariances: fitted on scenes for tuning, tested on held-out ones and recordings.

    python tests/benchmarks/covariance_calibration.py --record ./excerpts/rgbd_dataset_freiburg1_xyz

A clip's own factor makes the median NEES of its motions from frame to frame that of chi-square. The fitted factor is
the median of these over all clips of the fit (it contains the `COVARIANCE_FACTOR` of the code that made them); its
spread are their 10 % and 90 % quantiles. A row of the table has the factor fitted without its family, the clip's own,
and with the former NEES / 6 (mean, and median over chi-square's) and the share within the 95 % ellipsoid over one frame
and one second; 1, 1 and 95 % are right. Recordings count the noise of their truth.
"""

import one_thread  # noqa: F401  # before all others

# isort: split
from pathlib import Path

import numpy as np
from command_line import parser_of
from tracked import Clip, Tracked, track

from dynslam_bench.evaluation.uncertainty import Uncertainty, motion_uncertainty, truth_noise
from dynslam_bench.geometry.motion_covariances import MotionCovariances
from dynslam_bench.slam.pose_optimisation import COVARIANCE_FACTOR

FAMILIES = (
    "walking_xyz",
    "sitting_halfsphere",
    "loop_room",
    "fast_desk",
    "objects_box_aside",
    "objects_door",
)
TRACKERS = ("orb-slam2", "emfoa-oft?masks=none")
ROUNDS = 6
"""Rounds of the fit of a clip's factor: with noise of the truth the NEES is not proportional to it."""


def main() -> None:
    """Track the clips, fit the factors, and print a table a tracker."""
    parser = parser_of(
        __doc__,
        fit=[11],
        test=[130],
        frames=45,
        families=list(FAMILIES),
        trackers=list(TRACKERS),
        record=[""],
    )
    chosen = parser.parse_args()

    # every clip is read once, and tracked by all trackers
    fits: dict[str, dict[str, list[float]]] = {
        tracker: {family: [] for family in chosen.families} for tracker in chosen.trackers
    }
    tests: dict[str, list[tuple[str, str, Tracked]]] = {tracker: [] for tracker in chosen.trackers}
    for family in chosen.families:
        for scene in [*chosen.fit, *chosen.test]:
            name = f"synthetic/{family}?scene={scene}&frames={chosen.frames}"
            clip = Clip(name)
            for tracker in chosen.trackers:
                tracked = track(tracker, clip)
                if scene in chosen.test:
                    tests[tracker].append((family, f"{family} {scene}", tracked))
                elif scores(tracked, 1.0).metrics:
                    fits[tracker][family].append(own_factor(tracked))
    for name in filter(None, chosen.record):
        clip = Clip(name)
        for tracker in chosen.trackers:
            tests[tracker].append(("", Path(name).name, track(tracker, clip)))
    for tracker in chosen.trackers:
        print_table(tracker, fits[tracker], tests[tracker])


def print_table(
    tracker: str, factors: dict[str, list[float]], tests: list[tuple[str, str, Tracked]]
) -> None:
    """Print the fitted factor, and how it does on the clips of the test."""
    every = np.log([factor for values in factors.values() for factor in values])
    low, factor, high = np.exp(np.quantile(every, [0.1, 0.5, 0.9])) * COVARIANCE_FACTOR
    print(f"\n{tracker}: factor {factor:.3g} [{low:.3g}, {high:.3g}] over {len(every)} clips")
    print("by family:", {name: [round(value, 2) for value in own] for name, own in factors.items()})
    print("\n| clip | factor | own | 1 frame: mean, median, within | 1 second |")
    print("| --- | ---: | ---: | ---: | ---: |")
    for family, name, tracked in tests:
        others = [value for of, values in factors.items() if of != family for value in values]
        without = float(np.exp(np.median(np.log(others))))
        metrics = scores(tracked, without).metrics
        if not metrics:
            print(f"| {name} | | no motion is scored | | |")
            continue
        spans = [span_cell(metrics, span) for span in ("1f", "1s")]
        own = own_factor(tracked) * COVARIANCE_FACTOR
        print(f"| {name} | {without * COVARIANCE_FACTOR:.3g} | {own:.3g} |", " | ".join(spans), "|")


def scores(tracked: Tracked, factor: float) -> Uncertainty:
    """The scores with the covariances times a factor."""
    scaled = MotionCovariances(
        tracked.covariances.timestamps, factor * tracked.covariances.matrices
    )
    noise = truth_noise(tracked.clip.id)
    return motion_uncertainty(tracked.poses, scaled, tracked.clip.truth, noise)


def own_factor(tracked: Tracked) -> float:
    """The factor that makes the median NEES from frame to frame that of chi-square."""
    factor = 1.0
    for _ in range(ROUNDS):
        factor *= scores(tracked, factor).metrics["nees_1f_median"]
    return factor


def span_cell(metrics: dict[str, float], span: str) -> str:
    """The scores of a span, or nothing where the clip is shorter."""
    if f"nees_{span}_mean" not in metrics:
        return ""
    mean = metrics[f"nees_{span}_mean"]
    median = metrics[f"nees_{span}_median"]
    return f"{mean:.2f}, {median:.2f}, {metrics[f'within95_{span}']:.0%}"


if __name__ == "__main__":
    main()
