"""Real people pasted into real recordings: errors of trackers on many instances, beside those on the hosts alone.

    python tests/benchmarks/composites.py ./excerpts/rgbd_dataset_freiburg1_xyz --with
    ./excerpts/man_130 --instances 10

The first table has a row a tracker: the median hold-last-pose ATE over instances with a 95 %
interval (bootstrap), the ratio to the tracker's error on the host of each instance (geometric mean;
that of orb-slam2 where a tracker needs masks), and the worst instance. The second one has the error
of the last tracker by the share of the pixels that people fill.
"""

from pathlib import Path

import numpy as np
import pandas as pd
from command_line import parser_of

import dynslam_bench as db
from dynslam_bench.api import make_specs, run_specs
from dynslam_bench.core.settings import parse_assignments
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.sequences.compose import compose

FOLDER = Path("results/composites")
TRACKERS = (
    "orb-slam2", "opencv-odometry", "dynaslam-g", "dai-slam", "opf-slam", "emfoa-oft?masks=none",
    *(f"{name} segmentation.source=oracle" for name in (
        "mask-rcnn", "dynaslam", "dynaslam-n", "ds-slam", "yolo-slam", "blitz-slam", "emfoa-oft",
    )),
    "orbslam3",
)  # fmt: skip


def main() -> None:
    """Make the instances and the runs, and print the tables."""
    parser = parser_of(__doc__, instances=10)
    parser.add_argument("hosts", nargs="+")
    parser.add_argument("--with", dest="people", required=True)
    chosen = parser.parse_args()
    people = open_sequence(chosen.people)
    hosts: dict[str, str] = {}
    for host, instance in ((host, k) for host in chosen.hosts for k in range(chosen.instances)):
        folder = FOLDER / f"{Path(host).name}_{instance}"
        if not folder.is_dir():
            compose(open_sequence(host), people, folder, instance)
        hosts[str(folder)] = host
    shares = {name: share_of(name) for name in hosts}
    lines = []
    errors = pd.Series(dtype=float)
    for text in TRACKERS:
        tracker, *assignments = text.split()
        masked = any(part.startswith("segmentation.source") for part in assignments)
        base = errors_of(*(("orb-slam2", []) if masked else (tracker, assignments)), chosen.hosts)
        errors = errors_of(tracker, assignments, list(hosts))
        ratios = np.log([errors[name] / base[host] for name, host in hosts.items()])
        low, high = interval(errors.to_numpy())
        lines.append(
            f"| `{text}` | {1e3 * base.median():.1f} | {1e3 * errors.median():.1f} [{1e3 * low:.1f}, {1e3 * high:.1f}] "
            f"| {np.exp(ratios.mean()):.2f} | {1e3 * errors.max():.1f} ({Path(str(errors.idxmax())).name}) |"
        )
    print("| tracker | host mm | composites mm, median [95 %] | ratio to the host | worst mm |")
    print("| --- | ---: | ---: | ---: | ---: |", *lines, sep="\n", end="\n\n")
    print(f"| people fill | instances | `{TRACKERS[-1]}`, median mm |\n| --- | ---: | ---: |")
    thirds = pd.qcut(pd.Series(shares), 3)
    for span, names in thirds.groupby(thirds, observed=True).groups.items():
        print(
            f"| {span.left:.0%} to {span.right:.0%} | {len(names)} | {1e3 * errors[names].median():.1f} |"
        )


def errors_of(tracker: str, assignments: list[str], sequences: list[str]) -> pd.Series:
    """Hold-last-pose ATE in metres of a tracker by sequence; a run without one counts as a static camera."""
    runs = run_specs(
        make_specs(tracker, sequences, settings=parse_assignments(assignments)),
        results=FOLDER / "runs",
    )
    table = db.load(FOLDER / "runs").set_index("run_id").loc[[run.record.run_id for run in runs]]
    return pd.Series(
        table["hold_last_pose_ate_m"]
        .fillna(table["static_camera_ate_rmse_m"])
        .astype(float)
        .to_numpy(),
        index=sequences,
    )


def share_of(name: str) -> float:
    """Mean share of the pixels that people fill in a composite."""
    sequence = open_sequence(name)
    return float(
        np.mean([np.mean(sequence.masks[i].instances > 0) for i in range(0, len(sequence), 5)])
    )


def interval(values: np.ndarray) -> tuple[float, float]:
    """95 % interval of the median over instances, by resampling them."""
    low, high = np.quantile(
        np.median(np.random.default_rng(0).choice(values, (2000, len(values))), axis=1),
        [0.025, 0.975],
    )
    return float(low), float(high)


if __name__ == "__main__":
    main()
