"""``import`` and ``export``: trajectories from elsewhere beside our runs, and our runs in the formats of others."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Optional

import typer

from . import completion
from .options import TRAJECTORY_FORMATS as FORMATS
from .options import AsJson, Camera, DataRoot, Frames, ProtocolId, Results, Stride, Timestamps
from .output import SOME_RUNS_FAILED, complain, write, write_json
from .panels import MEASURE
from .run_rows import show_runs


def add(app: typer.Typer) -> None:
    """Add the verbs."""
    app.command("import", rich_help_panel=MEASURE)(import_)
    app.command("export", rich_help_panel=MEASURE)(export)


def import_(
    trajectory: Annotated[Path, typer.Argument(help=f"A trajectory: {FORMATS}.")],
    tracker: Annotated[str, typer.Option(help="Name of the system that made it.")],
    sequence: Annotated[str, typer.Option(help="Id or folder of the sequence that it was made on.")],
    label: Annotated[str, typer.Option(help="Name for tables.")] = "",
    provenance: Annotated[
        str, typer.Option(help="Where it comes from, e.g. a URL; an export's own provenance.json says it, too.")
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
    topic: Annotated[Optional[str], typer.Option(help="Of a bag: the topic of the poses.")] = None,  # noqa: UP045
    as_json: AsJson = False,
) -> None:
    """Put a trajectory from elsewhere beside our own runs."""
    from dynslam_bench.runs import RunStore, import_trajectory

    store = RunStore(results)
    record = import_trajectory(
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
    )
    show_runs([record], store, protocol, as_json=as_json)
    if record.status == "lost":
        raise typer.Exit(SOME_RUNS_FAILED)


def export(
    form: Annotated[
        str,
        typer.Argument(
            metavar="FORMAT",
            help="tum, kitti, euroc, vslam-lab, colmap, mcap or rrd (rerun).",
            autocompletion=completion.export_formats,
        ),
    ],
    run: Annotated[str, typer.Argument(help="The run's id, its first digits, or latest.")] = "latest",
    output: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--output", "-o", help="Folder to write; default exports/RUN/FORMAT of the results folder."),
    ] = None,
    online: Annotated[
        Optional[bool],  # noqa: UP045
        typer.Option("--online/--final", help="Which trajectory; default the final one, else the online one."),
    ] = None,
    results: Results = Path("results"),
    data_root: DataRoot = None,
    camera: Camera = None,
    as_json: AsJson = False,
) -> None:
    """Write a stored run in a format of other tools, with its provenance beside it."""
    from dynslam_bench.runs import export_run

    which: Literal["online", "final"] | None = None if online is None else ("online" if online else "final")
    done = export_run(run, form, output, results=results, which=which, data_root=data_root, camera=camera)
    if as_json:
        write_json({"folder": done.folder, "files": done.files, "which": done.which, "notes": done.notes})
        return
    for name in done.files:
        write(str(done.folder / name))
    for line in done.notes:
        complain(line)
