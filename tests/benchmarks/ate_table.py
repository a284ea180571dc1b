"""Run trackers on sequences and print a Markdown table of their errors.

    python tests/benchmarks/ate_table.py --trackers orb-slam2 'emfoa-oft segmentation.source=oracle'
    \\
        --sequences ./excerpts/rgbd_bonn_crowd 'synthetic/walking_xyz?scene=100' --offsets 0 3 --cell mean

A tracker may be followed by settings; with ``--scenes`` the runs of all those scenes of a sequence
are one cell. With one ``--show`` a row is a tracker and a column a sequence; with several a row is
a tracker on a sequence. A cell holds the values of all runs (one for each start offset and seed),
or their mean with the standard deviation, or their median with the range. Errors are those of
tracked frames unless ``hold`` is shown; the least coverage follows in brackets where it is below 95
%. Runs are kept in ``--results`` and made once.
"""

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
from command_line import parser_of

import dynslam_bench as db
from dynslam_bench.api import RunResult, make_specs, run_specs
from dynslam_bench.core.settings import parse_assignments

COLUMNS = {
    "ate": ("online ATE mm", "ate_rmse_m", 1e3),
    "final": ("final ATE mm", "final_ate_m", 1e3),
    "hold": ("hold-last-pose ATE mm", "hold_last_pose_ate_m", 1e3),
    "static": ("static camera mm", "static_camera_ate_rmse_m", 1e3),
    "farthest": ("farthest mm", "farthest_m", 1e3),
    "path": ("path mm", "path_m", 1e3),
    "coverage": ("coverage %", "coverage", 1e2),
    "skipped": ("F not used %", "epipolar_skipped", 1e2),
    "frame": ("frame ms", "frame_ms", 1),
    "p95": ("95 % of frames, ms", "frame_p95_s", 1e3),
    "dropped": ("dropped %", "dropped", 1e2),
    "memory": ("memory MB", "peak_memory_mb", 1),
    "keyframes": ("keyframes", "keyframes", 1),
    "loops": ("loops closed", "loops", 1),
}


def digits(value: float) -> str:
    """A count, or a figure with a tenth below a hundred; a dash where there is none."""
    return (
        "-"
        if np.isnan(value)
        else f"{value:.0f}"
        if value >= 99.95 or value.dtype.kind == "i"
        else f"{value:.1f}"
    )


CELLS: dict[str, Callable[[Sequence[float]], str]] = {
    "values": lambda values: ", ".join(map(digits, values)),
    "mean": lambda values: f"{digits(np.mean(values))} ± {digits(np.std(values, ddof=1))}",
    "median": lambda values: (
        f"{digits(np.median(values))} [{digits(np.min(values))} - {digits(np.max(values))}]"
    ),
}


def measured(run: RunResult) -> dict[str, float]:
    """What a run's row does not hold; path length and largest distance from the first pose are in metres."""
    positions = np.zeros((1, 3)) if run.trajectory is None else run.trajectory.positions
    return {
        "keyframes": run.record.keyframes,
        "loops": int(run.frames().get("stat_loops", pd.Series([0])).max()),
        "dropped": run.record.n_dropped / run.record.n_frames,
        "frame_p95_s": run.record.timings["total"].p95_s,
        "path_m": np.linalg.norm(np.diff(positions, axis=0), axis=1).sum(),
        "farthest_m": np.linalg.norm(positions - positions[0], axis=1).max(),
    }


def cell(runs: pd.DataFrame, show: str, style: str) -> str:
    """The runs of one tracker on one sequence."""
    _, column, scale = COLUMNS[show]
    values = scale * runs[column].to_numpy(
        int if pd.api.types.is_integer_dtype(runs[column]) else float
    )
    text = digits(values[0]) if len(set(values)) == 1 else CELLS[style](values)
    least = runs["coverage"].min()
    note = f" ({least:.0%} tracked)" if show in ("ate", "final") and least < 0.95 else ""
    failed = runs.loc[runs["status"] != "ok", "status"].unique()
    return f"{text}{note}{' ' if len(failed) else ''}{', '.join(failed)}"


def main() -> None:
    """Make the runs and print the table."""
    parser = parser_of(
        __doc__, offsets=[0], seeds=[0], stride=1, protocol="tum-rgbd/v1", jobs=1, results="results/tables",
        realtime=False,
    )  # fmt: skip
    parser.add_argument("--scenes", nargs="+", type=int, default=[])
    parser.add_argument(
        "--trackers", nargs="+", required=True, metavar="'TRACKER [NAME=VALUE ...]'"
    )
    parser.add_argument("--sequences", nargs="+", required=True)
    parser.add_argument("--show", nargs="+", default=["ate"], choices=COLUMNS)
    parser.add_argument("--cell", default="values", choices=CELLS)
    parser.add_argument("--frames", help="part of each sequence, A:B")
    chosen = parser.parse_args()
    specs = []
    keys = []
    for text, sequence in itertools.product(chosen.trackers, chosen.sequences):
        tracker, *assignments = text.split()
        new = make_specs(
            tracker, [f"{sequence}?scene={scene}" for scene in chosen.scenes] or [sequence],
            settings=parse_assignments(assignments), seeds=chosen.seeds,
            offsets=chosen.offsets, frames=chosen.frames, stride=chosen.stride,
            realtime=chosen.realtime,
        )  # fmt: skip
        specs += new
        keys += [(text, sequence)] * len(new)
    runs = run_specs(specs, results=chosen.results, protocol=chosen.protocol, jobs=chosen.jobs)
    table = (
        db.load(chosen.results, chosen.protocol)
        .set_index("run_id")
        .loc[[run.record.run_id for run in runs]]
    )
    table = table.drop(columns="keyframes", errors="ignore").join(
        pd.DataFrame(map(measured, runs), table.index)
    )
    cells = {key: part for key, part in table.groupby(pd.MultiIndex.from_tuples(keys), sort=False)}
    names = {sequence: sequence.rstrip("/").rpartition("/")[2] for sequence in chosen.sequences}
    labels = {
        text: f"`{text.split()[0]}`"
        + "".join(f", {part.rpartition('/')[2]}" for part in text.split()[1:])
        for text in chosen.trackers
    }
    if len(chosen.show) == 1:
        head = ["tracker", *names.values()]
        lines = [
            [
                labels[text],
                *(cell(cells[text, sequence], chosen.show[0], chosen.cell) for sequence in names),
            ]
            for text in labels
        ]
    else:
        head = ["sequence", "tracker", *(COLUMNS[show][0] for show in chosen.show)]
        lines = [
            [
                names[sequence],
                labels[text],
                *(cell(cells[text, sequence], show, chosen.cell) for show in chosen.show),
            ]
            for sequence, text in itertools.product(names, labels)
        ]
    rule = ["---"] * (1 + (len(chosen.show) > 1)) + ["---:"] * (
        len(head) - 1 - (len(chosen.show) > 1)
    )
    print("\n".join(f"| {' | '.join(line)} |" for line in [head, rule, *lines]), end="\n\n")


if __name__ == "__main__":
    main()
