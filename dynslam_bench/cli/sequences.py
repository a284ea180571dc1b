"""``sequences list|info|fetch|verify|doctor|calibrate|unpack|render|compose``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from fnmatch import fnmatch
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from dynslam_bench.cli.options import AsJson, Camera, DataRoot, Frames, complete_sequences
from dynslam_bench.cli.output import fields, note, present, progress, table, warn, write
from dynslam_bench.core import SequenceError, did_you_mean, find_data_root

if TYPE_CHECKING:
    from dynslam_bench.sequences.calibration import Quantity
    from dynslam_bench.sequences.fetch import Verification

app = typer.Typer(help="Find, fetch, check and render sequences.", no_args_is_help=True)
Name = Annotated[
    str,
    typer.Argument(help="Id, published folder name or path.", autocompletion=complete_sequences),
]


@app.command("list")
def list_(
    pattern: Annotated[str, typer.Argument(help="Which, e.g. tum/fr3 or 'tum/fr3/*xyz'.")] = "*",
    tag: Annotated[
        str | None,
        typer.Option(
            help="Only those with a tag: static, low-dynamic, high-dynamic, unknown-objects."
        ),
    ] = None,
    here: Annotated[bool, typer.Option("--here", help="Only those on this machine.")] = False,
    data_root: DataRoot = None,
    as_json: AsJson = False,
) -> None:
    """List all sequences and whether they are on this machine."""
    from dynslam_bench.sequences.catalogue import summaries

    everything = summaries(data_root=data_root)
    tags = sorted({name for summary in everything for name in summary["tags"]})
    if tag is not None and tag not in tags:
        raise SequenceError(f"no sequence has the tag '{tag}'", f"known: {', '.join(tags)}")
    # `tum/fr3` stands for all below it, too
    patterns = (pattern, f"{pattern.rstrip('/')}/*")
    matches = [
        summary for summary in everything if any(fnmatch(summary["id"], glob) for glob in patterns)
    ]
    if not matches:
        raise SequenceError(
            f"no sequence matches '{pattern}'",
            did_you_mean(pattern, [summary["id"] for summary in everything]),
        )
    if tag is not None:
        matches = [summary for summary in matches if tag in summary["tags"]]
    if here:
        matches = [summary for summary in matches if summary["here"]]

    lines = []
    for dataset, members in groupby(matches, key=itemgetter("dataset")):
        lines += dataset_lines(dataset, list(members))
    if not lines:
        command = "dynslam-bench sequences list"
        lines = [f"none of these is here or has the tag; all {len(everything)}: {command}"]
    present(matches, *lines)


def dataset_lines(dataset: str, summaries: Sequence[Mapping[str, Any]]) -> list[str]:
    """A heading with what a dataset's sequences share, their table, and an empty line.

    Args:
        dataset: The dataset's title.
        summaries: Its sequences, as `catalogue.summaries` describes them; at least one.
    """
    first = summaries[0]
    here = sum(summary["here"] for summary in summaries)
    facts = [f"{len(summaries)} listed, {here} here", f"licence: {first['license']}"]
    if first["layout"]:
        facts.append(f"layout: {first['layout']} on the publisher's files")
    if first["by_hand"]:
        facts.append(f"by hand: {first['by_hand']}")
    columns = ("sequence", "here", "size", "tags", "split", "ground truth", "checksum")
    keys = ("id", "here", "size", "tags", "split", "ground_truth", "checksum")
    rows = [[summary[key] for key in keys] for summary in summaries]
    return [f"{dataset} ({'; '.join(facts)})", table(columns, rows), ""]


@app.command()
def info(
    name: Name,
    data_root: DataRoot = None,
    camera: Camera = None,
    as_json: AsJson = False,
) -> None:
    """Show the facts of a sequence, and its contents if it is on this machine."""
    from dynslam_bench.sequences.catalogue import describe

    facts = describe(name, data_root=data_root, camera=camera)
    present(facts, fields(facts))


@app.command()
def fetch(
    names: Annotated[
        list[str],
        typer.Argument(help="Ids or patterns such as 'bonn/*'.", autocompletion=complete_sequences),
    ],
    data_root: DataRoot = None,
    url: Annotated[Optional[str], typer.Option(help="A mirror's address of the archive.")] = None,
    checksum: Annotated[
        bool, typer.Option(help="Refuse an archive whose checksum is not the known one.")
    ] = True,
    keep_archive: Annotated[
        bool, typer.Option("--keep-archive", help="Keep the archive, too.")
    ] = False,
) -> None:
    """Download public sequences; a call that was cut short goes on where it stopped."""
    from dynslam_bench.sequences.catalogue import expand
    from dynslam_bench.sequences.fetch import RECEIPT, Receipt, status
    from dynslam_bench.sequences.fetch import fetch as fetch_one

    for name in expand(names):
        is_new = status(name, data_root=data_root) is None
        with progress(name, unit="bytes") as advance:
            folder = fetch_one(
                name,
                data_root=data_root,
                progress=lambda state, advance=advance: advance(state.done, state.total),  # type: ignore[misc]
                checksum=checksum,
                keep_archive=keep_archive,
                url=url,
            )
        write(str(folder))
        if not is_new:
            continue
        receipt = Receipt.read(folder / RECEIPT)
        if not receipt.checked:
            warn(
                f"warning: no checksum of {name} is published; that of this archive is {receipt.sha256}, "
                "and the next fetch from there has to have the same"
            )


@app.command()
def verify(
    names: Annotated[
        list[str], typer.Argument(help="Ids, patterns or paths.", autocompletion=complete_sequences)
    ],
    data_root: DataRoot = None,
    camera: Camera = None,
    as_json: AsJson = False,
) -> None:
    """Decode every frame, and compare every file with the checksum taken when it was fetched."""
    from dynslam_bench.sequences.catalogue import expand
    from dynslam_bench.sequences.fetch import verify as verify_one

    reports = []
    lines = []
    for name in expand(names):
        with progress(name) as advance:
            report = verify_one(name, data_root=data_root, camera=camera, progress=advance)
        reports.append(report)
        lines += verification_lines(report)
    facts = [{**asdict(report), "ok": report.ok} for report in reports]
    present(facts, *lines, verified=all(report.ok for report in reports))


def verification_lines(report: Verification) -> list[str]:
    """The verdict on a sequence's files, then the what was not used on opening, and each fault."""
    verdict = "ok"
    if not report.ok:
        plural = "s" if len(report.faults) != 1 else ""
        verdict = f"{len(report.faults)} fault{plural}"
    compared = "not fetched by this program, frames decoded only"
    if report.manifest:
        compared = "every file as fetched"
    lines = [f"{report.id}: {verdict}, {report.frames} frames, {compared}"]
    if report.dropped:
        lines.append(f"  {report.dropped}")
    return lines + [f"  {fault}" for fault in report.faults]


@app.command()
def doctor(
    name: Name,
    data_root: DataRoot = None,
    camera: Camera = None,
    as_json: AsJson = False,
) -> None:
    """Compare a recording's images with its camera and its truth; exits with 4 if there is a fault."""
    from dynslam_bench.sequences.doctor import diagnose

    with progress(name) as advance:
        diagnosis = diagnose(name, data_root=data_root, camera=camera, progress=advance)
    facts = {**asdict(diagnosis), "ok": diagnosis.ok, "verdict": diagnosis.verdict}
    lines = []
    for finding in diagnosis.findings:
        lines += [f"{finding.severity} {finding.id}: {finding.text}", f"  cure: {finding.cure}"]
    lines.append(f"{diagnosis.id}: {diagnosis.frames} frames compared, {diagnosis.verdict}")
    present(facts, *lines, verified=diagnosis.ok)


@app.command()
def unpack(
    bag: Annotated[
        Path, typer.Argument(help="A ROS 1 .bag, a ROS 2 folder, an .mcap or .db3 file.")
    ],
    folder: Annotated[Path, typer.Argument(help="The folder to make, in TUM layout.")],
    colour: Annotated[Optional[str], typer.Option(help="Topic of the colour images.")] = None,
    depth: Annotated[Optional[str], typer.Option(help="Topic of registered depth images.")] = None,
    truth: Annotated[
        Optional[str], typer.Option(help="Topic of the camera's true poses, or none.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Unpack a ROS bag or MCAP file into a folder that is a sequence."""
    from dynslam_bench.sequences.bags import unpack_bag

    unpacked = unpack_bag(bag, folder, colour=colour, depth=depth, truth=truth)
    for line in unpacked.notes:
        note(line)
    poses = f", poses from {unpacked.truth}" if unpacked.truth else ", no ground truth"
    frames = f"{unpacked.frames} frames from {unpacked.colour} and {unpacked.depth}"
    present(unpacked, f"{unpacked.folder}: {frames}{poses}")


@app.command()
def render(
    names: Annotated[
        list[str], typer.Argument(help="Such as 'synthetic/walking_xyz?scene=0&frames=600'.")
    ],
    data_root: DataRoot = None,
    threads: Annotated[
        Optional[int], typer.Option(min=1, help="Frames rendered at a time.")
    ] = None,
) -> None:
    """Render sequences now, in place of when they are first read."""
    from dynslam_bench.sequences.synthetic import render_synthetic

    for name in names:
        with progress(name) as advance:
            folder = render_synthetic(
                name, find_data_root(data_root), threads=threads, progress=advance
            )
        note(f"{name} is in")
        write(str(folder))


@app.command()
def compose(
    host: Name,
    folder: Annotated[Path, typer.Argument(help="The folder to make, in TUM layout.")],
    people: Annotated[
        str, typer.Option("--with", help="Recording of people by a camera that does not move.")
    ],
    instance: Annotated[
        int, typer.Option(min=0, help="Which placement of one to three people.")
    ] = 0,
    frames: Frames = None,
    data_root: DataRoot = None,
    as_json: AsJson = False,
) -> None:
    """Paste real people into a recording that has a truth: exact masks, the host's poses."""
    from dynslam_bench.sequences import open_sequence
    from dynslam_bench.sequences.compose import compose as paste

    background = open_sequence(host, data_root=data_root, frames=frames)
    foreground = open_sequence(people, data_root=data_root)
    with progress(str(folder)) as advance:
        made = paste(background, foreground, folder, instance, progress=advance)
    average = f"{100 * made.share:.0f} % of the pixels on average"
    largest = f"{100 * made.largest_share:.0f} % at most"
    present(
        made,
        f"{made.folder}: {made.frames} frames, people fill {average} and {largest}",
    )


@app.command()
def calibrate(
    name: Annotated[
        str, typer.Argument(help="Path or id of a recording.", autocompletion=complete_sequences)
    ],
    data_root: DataRoot = None,
    camera: Camera = None,
    frames: Frames = None,
    output: Annotated[
        Optional[Path],
        typer.Option(help="Write the camera, with what was measured, to this camera.toml."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure the readout time of a rolling shutter, the delay of depth, and the depth factor."""
    from dynslam_bench.sequences import open_sequence
    from dynslam_bench.sequences.calibration import calibrate as measure
    from dynslam_bench.sequences.cameras import write_camera

    sequence = open_sequence(name, data_root=data_root, camera=camera, frames=frames)
    with progress(name) as advance:
        result = measure(sequence, progress=advance)
    written = output if result.measured else None
    if written is not None:
        write_camera(written, result.camera, fps=sequence.fps)

    columns = ("quantity", "estimate", "95 % interval", "camera.toml", "why")
    data = f"{result.windows} windows of {result.frames} frames"
    lines = [
        table(columns, [_quantity_row(quantity) for quantity in result.quantities]),
        f"{data}, keypoints to {result.pixel_noise:.2f} px",
    ]
    if written is not None:
        lines.append(str(written))
    present({**asdict(result), "file": written}, *lines)
    if output is not None and written is None:
        note(f"nothing to write: {output} is left alone")


def _quantity_row(quantity: Quantity) -> tuple[str, ...]:
    """A row of the table of `calibrate`: name, estimate, interval, what the file gets, and why."""
    # times are measured in seconds and shown in milliseconds
    scale, unit = (1.0, "a metre") if quantity.name == "depth_factor" else (1e3, "ms")
    value = "" if quantity.value is None else f"{scale * quantity.value:.4g} {unit}"
    limits = [
        f"{scale * limit:.4g}" for limit in (quantity.low, quantity.high) if limit is not None
    ]
    kept = "kept" if quantity.observable else "not observable"
    written = kept if quantity.written is None else f"{quantity.written:g}"
    return (
        quantity.name,
        value,
        " to ".join(limits),
        written,
        quantity.reason,
    )
