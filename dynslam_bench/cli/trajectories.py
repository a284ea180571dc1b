"""``eval``, ``protocols list|compare``, ``import`` and ``export``: trajectory files, scored and exchanged."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Optional

import typer

from dynslam_bench import runs
from dynslam_bench.cli.metric_tables import comparison_table, statistics_table
from dynslam_bench.cli.options import (
    AsJson,
    Camera,
    DataRoot,
    Frames,
    ProtocolId,
    Results,
    Stride,
    Timestamps,
    names_of,
)
from dynslam_bench.cli.output import SOME_RUNS_FAILED, announce, present, table
from dynslam_bench.cli.runs import show_runs

if TYPE_CHECKING:
    from dynslam_bench.evaluation import Evaluation, Hint
    from dynslam_bench.geometry import LoadedTrajectory

protocols = typer.Typer(
    help="How errors are measured, and how much that alone changes.", no_args_is_help=True
)
Estimate = Annotated[
    Path,
    typer.Argument(
        help="A trajectory: TUM, EuRoC, VSLAM-LAB, a bag; KITTI or COLMAP with --timestamps."
    ),
]
GroundTruth = Annotated[Path, typer.Argument(help="Ground truth, in any of these formats.")]
Topics = Annotated[
    Optional[list[str]],
    typer.Option("--topic", help="Topic of a bag's poses; a second one for the truth's."),
]


def evaluate(
    estimates: Annotated[
        list[Path],
        typer.Argument(
            metavar="ESTIMATE...",
            help="Trajectories: TUM, EuRoC, VSLAM-LAB, a bag; KITTI or COLMAP with --timestamps.",
        ),
    ],
    ground_truth: GroundTruth,
    protocol: ProtocolId = "tum-rgbd/v1",
    timestamps: Timestamps = None,
    topic: Topics = None,
    plot: Annotated[
        Optional[Path],
        typer.Option(help="Draw tracks and errors over time: FILE.png, .svg, .pdf or .html."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Evaluate trajectory files against a ground-truth file."""
    # all files are read and scored before anything is written
    pairs = [read_pair(estimate, ground_truth, timestamps, topic) for estimate in estimates]
    scored = [scored_with_hints(loaded, truth, protocol) for loaded, truth in pairs]
    drawn = None
    if plot is not None:
        drawn = draw([path.stem for path in estimates], pairs, protocol, plot)

    facts = [{**result.model_dump(), "hints": likely} for result, likely in scored]
    written = [] if drawn is None else [str(drawn)]
    # one file in full
    if len(scored) == 1:
        result, likely = scored[0]
        lines = [result.summary(), result.protocol, statistics_table(result.metrics)]
        present(facts[0], *lines, *remarks(result, likely), *written)
        return
    # several side by side, with the remarks on each
    names = [path.name for path in estimates]
    results = [result for result, _ in scored]
    lines = [results[0].protocol, comparison_table(names, results)]
    for path, (result, likely) in zip(estimates, scored, strict=True):
        lines += [f"{path.name}: {line}" for line in remarks(result, likely)]
    facts = [{"file": str(path)} | fact for path, fact in zip(estimates, facts, strict=True)]
    present(facts, *lines, *written)


def draw(
    labels: list[str],
    pairs: list[tuple[LoadedTrajectory, LoadedTrajectory]],
    protocol: str,
    path: Path,
) -> Path:
    """Draw estimates beside their common ground truth; see `plot_trajectories`."""
    import numpy as np

    from dynslam_bench.evaluation import get_protocol
    from dynslam_bench.evaluation.comparison import truth_of_file
    from dynslam_bench.evaluation.evaluate import pose_errors
    from dynslam_bench.reports.trajectory_plot import PlottedTrajectory, plot_trajectories

    # the truth as the protocol takes it; each estimate aligned with it
    truth = truth_of_file(pairs[0][1].trajectory, get_protocol(protocol))
    plotted = []
    for label, (loaded, _) in zip(labels, pairs, strict=True):
        aligned, _, series = pose_errors(loaded.trajectory, truth, protocol)
        errors_m = series["trans_m"]
        rmse_m = float(np.sqrt(np.square(errors_m).mean()))
        plotted.append(PlottedTrajectory(label, aligned, errors_m, rmse_m))
    return plot_trajectories(plotted, truth, path)


def read_pair(
    estimate: Path, ground_truth: Path, timestamps: Path | None, topics: list[str] | None
) -> tuple[LoadedTrajectory, LoadedTrajectory]:
    """An estimate and its ground truth; of several topics the first is the estimate's, the last the truth's."""
    topics = topics or []
    loaded = runs.read_trajectory(estimate, timestamps, *topics[:1])
    truth = runs.read_trajectory(ground_truth, timestamps, *topics[-1:])
    return loaded, truth


def scored_with_hints(
    loaded: LoadedTrajectory, truth: LoadedTrajectory, protocol: str
) -> tuple[Evaluation, tuple[Hint, ...]]:
    """The evaluation of a file under a protocol, and the hints on it."""
    from dynslam_bench.evaluation import get_protocol, hints
    from dynslam_bench.evaluation.comparison import truth_of_file
    from dynslam_bench.evaluation.evaluate import evaluate_loaded

    result = evaluate_loaded(loaded, truth, protocol)
    true_poses = truth_of_file(truth.trajectory, get_protocol(protocol))
    return result, hints(loaded.trajectory, true_poses, protocol, notes=loaded.notes)


def remarks(result: Evaluation, likely: tuple[Hint, ...]) -> list[str]:
    """Diagnostics, warnings and hints on an evaluation, one a line."""
    return [
        *result.diagnostics,
        *(f"warning: {line}" for line in result.warnings),
        *(f"hint: {hint}" for hint in likely),
    ]


@protocols.command("list")
def list_(as_json: AsJson = False) -> None:
    """List the protocols."""
    from dynslam_bench.evaluation import PROTOCOLS

    facts = []
    rows = []
    for protocol in PROTOCOLS.values():
        digest = protocol.digest()
        facts.append({"digest": digest, **protocol.model_dump()})
        rows.append((protocol.id, digest, protocol.describe()))
    present(facts, table(("id", "digest", "meaning"), rows))


@protocols.command()
def compare(
    estimate: Estimate,
    ground_truth: GroundTruth,
    published: Annotated[
        Optional[str],
        typer.Option(
            metavar="METRES",
            help="A published error as printed, e.g. 0.0733: mark the rows that agree.",
        ),
    ] = None,
    timestamps: Timestamps = None,
    topic: Topics = None,
    as_json: AsJson = False,
) -> None:
    """Show how one trajectory scores under every protocol of the field."""
    from dynslam_bench.evaluation.compare_protocols import agrees, compare_protocols

    # one trajectory under all protocols
    loaded, truth = read_pair(estimate, ground_truth, timestamps, topic)
    scores = compare_protocols(loaded, truth)
    lines = remarks(*scored_with_hints(loaded, truth, "tum-rgbd/v1"))
    columns = ["metric", "protocol", "rmse (mm)", "pairs", "note"]
    rows = []
    for score in scores:
        rmse_mm = None if score.rmse_m is None else 1000 * score.rmse_m
        rows.append([score.metric, score.label, rmse_mm, score.pairs, score.note])
    if published is None:
        present(scores, table(columns, rows), *lines)
        return

    # mark the protocols under which the published error comes out; without any, name the nearest
    marks = [agrees(score, published) for score in scores]
    defined = [score for score in scores if score.rmse_m is not None]
    nearest = min(defined, key=lambda score: abs((score.rmse_m or 0.0) - float(published)))
    if not any(marks):
        closest = f"the nearest is {nearest.label}, {nearest.rmse_m:.6f} m"
        lines.append(f"No row agrees with {published} m; {closest}.")
    columns.insert(2, "published")
    for row, mark in zip(rows, marks, strict=True):
        row.insert(2, "agrees" if mark else "")
    facts = [{**asdict(score), "agrees": mark} for score, mark in zip(scores, marks, strict=True)]
    present(facts, table(columns, rows), *lines)


def import_(
    trajectory: Annotated[
        Path,
        typer.Argument(
            help="TUM's, KITTI's (--timestamps), EuRoC's or VSLAM-LAB's csv, COLMAP's text, a bag, MCAP."
        ),
    ],
    tracker: Annotated[str, typer.Option(help="Name of the system that made it.")],
    sequence: Annotated[
        str, typer.Option(help="Id or folder of the sequence that it was made on.")
    ],
    label: Annotated[str, typer.Option(help="Name for tables.")] = "",
    provenance: Annotated[
        str,
        typer.Option(
            help="Where it comes from, e.g. a URL; an export's own provenance.json says it, too."
        ),
    ] = "",
    online: Annotated[
        bool, typer.Option("--online/--final", help="Causal poses, or those after optimisation.")
    ] = False,
    results: Results = Path("results"),
    data_root: DataRoot = None,
    camera: Camera = None,
    frames: Frames = None,
    stride: Stride = 1,
    protocol: ProtocolId = "tum-rgbd/v1",
    timestamps: Timestamps = None,
    topic: Annotated[Optional[str], typer.Option(help="Of a bag: the topic of the poses.")] = None,
    truth: Annotated[
        Optional[Path],
        typer.Option(
            help="Ground truth of a sequence whose images are not here; coverage is unknown then."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Put a trajectory from elsewhere beside our own runs."""
    # stored as a record beside the runs, then shown as one
    store = runs.RunStore(results)
    record = runs.import_trajectory(
        trajectory,
        tracker,
        sequence,
        results=store,
        label=label,
        provenance=provenance,
        which="online" if online else "final",
        frames=frames,
        stride=stride,
        data_root=data_root,
        camera=camera,
        timestamps=timestamps,
        topic=topic,
        truth=truth,
    )
    show_runs([record], store, protocol)
    if record.status == "lost":
        raise typer.Exit(SOME_RUNS_FAILED)


def export(
    form: Annotated[
        str,
        typer.Argument(
            metavar="FORMAT",
            help="tum, kitti, euroc, vslam-lab, colmap, mcap or rrd (rerun).",
            autocompletion=names_of("runs.exchange.transfer:FORMATS"),
        ),
    ],
    run: Annotated[
        str, typer.Argument(help="The run's id, its first digits, or latest.")
    ] = "latest",
    output: Annotated[
        Optional[Path],
        typer.Option(
            "--output",
            "-o",
            help="Folder to write; default exports/RUN/FORMAT of the results folder.",
        ),
    ] = None,
    online: Annotated[
        Optional[bool],
        typer.Option(
            "--online/--final", help="Which trajectory; default the final one, else the online one."
        ),
    ] = None,
    results: Results = Path("results"),
    data_root: DataRoot = None,
    camera: Camera = None,
    as_json: AsJson = False,
) -> None:
    """Write a stored run in a format of other tools, with its provenance beside it."""
    # without either option the run's best trajectory is taken
    which: Literal["online", "final"] | None = None
    if online is not None:
        which = "online" if online else "final"
    exported = runs.export_run(
        run, form, output, results=results, which=which, data_root=data_root, camera=camera
    )
    present(exported, *(str(exported.folder / name) for name in exported.files))
    for line in exported.notes:
        announce(line)
