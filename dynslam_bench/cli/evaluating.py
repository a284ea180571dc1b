"""``eval`` and ``protocols list|compare``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from .options import AsJson, ProtocolId, Timestamps
from .output import write, write_json, write_table
from .panels import MEASURE

protocols = typer.Typer(help="How errors are measured, and how much that alone changes.", no_args_is_help=True)
Estimate = Annotated[
    Path,
    typer.Argument(help="A trajectory: TUM, EuRoC, VSLAM-LAB, a bag; KITTI or COLMAP with --timestamps."),
]
GroundTruth = Annotated[Path, typer.Argument(help="Ground truth, in any of these formats.")]


def add(app: typer.Typer) -> None:
    """Add the verbs."""
    app.command("eval", rich_help_panel=MEASURE)(evaluate)
    app.add_typer(protocols, name="protocols", rich_help_panel=MEASURE)


def evaluate(
    estimate: Estimate,
    ground_truth: GroundTruth,
    protocol: ProtocolId = "tum-rgbd/v1",
    timestamps: Timestamps = None,
    as_json: AsJson = False,
) -> None:
    """Evaluate a trajectory file against a ground-truth file."""
    from dynslam_bench.evaluation import get_protocol, hints
    from dynslam_bench.evaluation.evaluate import evaluate_loaded
    from dynslam_bench.evaluation.prepare import truth_of_file
    from dynslam_bench.runs import read_trajectory

    read, truth = (read_trajectory(path, timestamps) for path in (estimate, ground_truth))
    result = evaluate_loaded(read, truth, protocol)
    known = truth_of_file(truth.trajectory, get_protocol(protocol))
    found = hints(read.trajectory, known, protocol, notes=read.notes)
    if as_json:
        write_json(result.model_dump(mode="json") | {"hints": [asdict(hint) for hint in found]})
        return
    write(result.summary())
    write(result.protocol)
    write_table(("metric", "value"), list(result.metrics.items()))
    for line in result.diagnostics:
        write(line)
    for hint in found:
        write(f"hint: {hint}")


@protocols.command("list")
def list_(as_json: AsJson = False) -> None:
    """List the protocols."""
    from dynslam_bench.evaluation import PROTOCOLS

    if as_json:
        write_json([{"digest": each.digest(), **each.model_dump(mode="json")} for each in PROTOCOLS.values()])
        return
    write_table(("id", "digest", "meaning"), [(each.id, each.digest(), each.describe()) for each in PROTOCOLS.values()])


@protocols.command()
def compare(
    estimate: Estimate, ground_truth: GroundTruth, timestamps: Timestamps = None, as_json: AsJson = False
) -> None:
    """Show how one trajectory scores under every protocol of the field."""
    from dynslam_bench.evaluation import compare_protocols
    from dynslam_bench.runs import read_trajectory

    loaded = [read_trajectory(path, timestamps).trajectory for path in (estimate, ground_truth)]
    rows = compare_protocols(loaded[0], loaded[1], of_file=True)
    if as_json:
        write_json([asdict(row) for row in rows])
        return
    write_table(
        ("metric", "protocol", "rmse (m)", "pairs", "note"),
        [(row.metric, row.label, row.rmse_m, row.pairs, row.note) for row in rows],
    )
