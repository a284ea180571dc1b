"""``segmenter train|evaluate|record|export``."""

from pathlib import Path
from typing import Annotated, Optional

import typer

from dynslam_bench.cli.options import (
    AsJson,
    Camera,
    DataRoot,
    Device,
    Frames,
    Threads,
    complete_sequences,
    gather_settings,
)
from dynslam_bench.cli.output import fields, present, progress, table, write

MaskAssignments = Annotated[
    Optional[list[str]],
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Set one of the masks', e.g. classes=person; repeatable.",
    ),
]

app = typer.Typer(
    help="Train, measure and export segmentation networks, record their masks.",
    no_args_is_help=True,
)


@app.command()
def train(
    output: Annotated[Path, typer.Argument(help="Folder of the training run.")],
    set_options: Annotated[
        Optional[list[str]],
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Set one of the training's, e.g. iterations=1200; repeatable.",
        ),
    ] = None,
    settings_file: Annotated[
        Optional[Path],
        typer.Option("--settings", help="TOML file of the training's settings."),
    ] = None,
    data_cache: Annotated[
        Optional[Path], typer.Option(help="Where prepared images are kept.")
    ] = None,
    device: Device = "auto",
    threads: Threads = 1,
    resume: Annotated[bool, typer.Option(help="Go on where an earlier call stopped.")] = True,
    as_json: AsJson = False,
) -> None:
    """Train a Mask R-CNN with a cross-layer feature pyramid; a call that was interrupted goes on."""
    from dynslam_bench.core.settings import apply_overrides
    from dynslam_bench.envs.slam_env import resolve_device
    from dynslam_bench.segmentation.training.settings import TrainSettings
    from dynslam_bench.segmentation.training.train import train as train_network

    chosen = apply_overrides(TrainSettings(), gather_settings(set_options, settings_file))
    with progress("training") as advance:
        result = train_network(
            chosen,
            output,
            data_cache=data_cache,
            device=resolve_device(device),
            threads=threads,
            resume=resume,
            progress=lambda state: advance(state.done, state.total),
        )
    facts = {"weights": result.best, "step": result.step, "iou": result.iou}
    present(facts, fields(facts))


@app.command()
def evaluate(
    data: Annotated[
        str, typer.Argument(help="synthetic:..., sequence:ID, coco:FILE[:IMAGES] or yolo:DIR.")
    ],
    source: Annotated[
        str, typer.Option(help="embedded, coco, selfie, weights:PATH, onnx:PATH, recorded:DIR ...")
    ] = "embedded",
    set_options: MaskAssignments = None,
    output: Annotated[
        Optional[Path], typer.Option("-o", "--output", help="JSON file of the scores.")
    ] = None,
    limit: Annotated[Optional[int], typer.Option(min=1, help="Only so many images.")] = None,
    min_area: Annotated[int, typer.Option(min=0, help="Leave out objects with fewer pixels.")] = 0,
    device: Device = "auto",
    threads: Threads = 1,
    as_json: AsJson = False,
) -> None:
    """Measure a segmenter's masks against labels."""
    from dynslam_bench.core.settings import apply_overrides
    from dynslam_bench.envs.slam_env import resolve_device
    from dynslam_bench.segmentation.settings import SegmentationSettings
    from dynslam_bench.segmentation.training.evaluate_masks import evaluate_segmenter

    settings = apply_overrides(
        SegmentationSettings(), {"source": source, **gather_settings(set_options)}
    )
    with progress(data) as advance:
        score = evaluate_segmenter(
            settings,
            data,
            output=output,
            device=resolve_device(device),
            threads=threads,
            min_area=min_area,
            limit=limit,
            progress=advance,
        )
    lines = [fields(score.model_dump(exclude={"classes"}))]
    if score.classes:
        columns = sorted({key for quality in score.classes.values() for key in quality})
        rows = [(name, *map(quality.get, columns)) for name, quality in score.classes.items()]
        lines += ["", table(("class", *columns), rows)]
    present(score, *lines)


@app.command()
def record(
    sequence: Annotated[str, typer.Argument(help="Id or path.", autocompletion=complete_sequences)],
    output: Annotated[
        Path, typer.Argument(help="Folder of the masks, for segmentation.source=recorded:DIR.")
    ],
    source: Annotated[
        str, typer.Option(help="coco, selfie, weights:PATH, onnx:PATH, oracle ...")
    ] = "auto",
    set_options: MaskAssignments = None,
    frames: Frames = None,
    data_root: DataRoot = None,
    camera: Camera = None,
    device: Device = "auto",
    threads: Threads = 1,
) -> None:
    """Write a segmenter's masks of a sequence as PNG files; a call that was interrupted goes on."""
    from dynslam_bench.core.settings import apply_overrides
    from dynslam_bench.envs.slam_env import resolve_device
    from dynslam_bench.segmentation.record import record_masks
    from dynslam_bench.segmentation.settings import SegmentationSettings
    from dynslam_bench.sequences import open_sequence

    settings = apply_overrides(
        SegmentationSettings(), {"source": source, **gather_settings(set_options)}
    )
    opened = open_sequence(sequence, data_root=data_root, camera=camera, frames=frames)
    with progress(f"masks of {opened.id}") as advance:
        made = record_masks(
            opened,
            output,
            settings,
            device=resolve_device(device),
            threads=threads,
            progress=advance,
        )
    write(
        f"{made} of {len(opened)} frames segmented now; use them with --set segmentation.source=recorded:{output}"
    )


@app.command()
def export(
    source: Annotated[str, typer.Argument(help="embedded, coco or weights:PATH.")],
    output: Annotated[
        Path, typer.Argument(help="ONNX file to write, for segmentation.source=onnx:FILE.")
    ],
    size: Annotated[str, typer.Option(metavar="WxH", help="Size of the images.")] = "640x480",
    side: Annotated[
        Optional[int],
        typer.Option(
            min=0,
            help="Shorter side at which the network works; default as in a run, 0 for its own.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write one of our networks as an ONNX file of fixed shapes, which lighter runtimes can serve."""
    from dynslam_bench.segmentation.networks.onnx_export import export_network, parse_size

    height, width = parse_size(size)
    classes = export_network(source, output, size=(height, width), side=side)
    facts = {
        "file": output,
        "megabytes": round(output.stat().st_size / 1e6, 1),
        "input": f"image [1, 3, {height}, {width}], RGB in [0, 1]",
        "classes": len(classes),
    }
    present(facts, fields(facts))
