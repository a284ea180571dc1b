"""``import``: trajectories from elsewhere beside our own runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import AsJson, Camera, DataRoot, Frames, ProtocolId, Results, Stride, Timestamps
from .panels import MEASURE
from .run_rows import show_runs


def add(app: typer.Typer) -> None:
    """Add the verb."""
    app.command("import", rich_help_panel=MEASURE)(import_)


def import_(
    trajectory: Annotated[Path, typer.Argument(help="Trajectory file in TUM format, or in KITTI's with --timestamps.")],
    tracker: Annotated[str, typer.Option(help="Name of the system that made it.")],
    sequence: Annotated[str, typer.Option(help="Id or folder of the sequence that it was made on.")],
    label: Annotated[str, typer.Option(help="Name for tables.")] = "",
    provenance: Annotated[str, typer.Option(help="Where it comes from, e.g. a URL.")] = "",
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
    )
    show_runs([record], store, protocol, as_json=as_json)
