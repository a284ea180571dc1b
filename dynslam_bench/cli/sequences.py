"""``sequences list|info|fetch|verify|doctor|calibrate|unpack|render``."""

from __future__ import annotations

import fnmatch
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from dynslam_bench.cli.options import AsJson, Camera, DataRoot, Frames, complete_sequences
from dynslam_bench.cli.output import (
    VERIFICATION_FAILED,
    note,
    present,
    progress,
    warn,
    write,
    write_fields,
    write_table,
)

if TYPE_CHECKING:
    from dynslam_bench.sequences.catalogue import Summary

app = typer.Typer(help="Find, fetch, check and render sequences.", no_args_is_help=True)
Name = Annotated[str, typer.Argument(help="Id, published folder name or path.", autocompletion=complete_sequences)]


@app.command("list")
def list_(
    pattern: Annotated[str, typer.Argument(help="Which, e.g. tum/fr3 or 'tum/fr3/*xyz'.")] = "*",
    tag: Annotated[Optional[str], typer.Option(help="Only static, low-dynamic or high-dynamic ones.")] = None,  # noqa: UP045
    here: Annotated[bool, typer.Option("--here", help="Only those on this machine.")] = False,
    data_root: DataRoot = None,
    as_json: AsJson = False,
) -> None:
    """List all sequences and whether they are on this machine."""
    from dynslam_bench.core.errors import SequenceError, did_you_mean
    from dynslam_bench.sequences.catalogue import summaries

    everything = summaries(data_root=data_root)
    tags = sorted({name for summary in everything for name in summary.tags})
    if tag is not None and tag not in tags:
        raise SequenceError(f"no sequence has the tag '{tag}'", f"known: {', '.join(tags)}")
    patterns = (pattern, f"{pattern.rstrip('/')}/*")
    pattern = next((p for p in patterns if any(fnmatch.fnmatch(s.id, p) for s in everything)), "")
    if not pattern:
        ids = [summary.id for summary in everything]
        raise SequenceError(f"no sequence matches '{patterns[0]}'", did_you_mean(patterns[0], ids))
    matches = [
        summary
        for summary in everything
        if fnmatch.fnmatch(summary.id, pattern) and (tag is None or tag in summary.tags) and (summary.here or not here)
    ]

    def show() -> None:
        if not matches:
            limits = [f"'{pattern}'", *([f"with the tag {tag}"] if tag else []), *(["on this machine"] if here else [])]
            write(f"no sequence matches {' '.join(limits)}; all {len(everything)}: dynslam-bench sequences list")
        for title, group in groupby(matches, key=lambda summary: summary.dataset):
            _write_group(title, list(group))

    present([asdict(summary) for summary in matches], show)


def _write_group(title: str, group: list[Summary]) -> None:
    """The sequences of a data set below a line of their common facts."""
    first = group[0]
    facts = [f"{len(group)} listed, {sum(summary.here for summary in group)} here", f"licence: {first.license}"]
    facts += [f"layout: {first.layout} on the publisher's files"] if first.layout else []
    facts += [f"by hand: {first.by_hand}"] if first.by_hand else []
    write(f"{title} ({'; '.join(facts)})")
    write_table(
        ("sequence", "here", "size", "tags", "split", "ground truth", "checksum"),
        [(s.id, s.here, s.size, s.tags, s.split, s.ground_truth, s.checksum) for s in group],
        spare=("checksum", "ground truth", "split"),
    )
    write()


@app.command()
def info(
    name: Name,
    data_root: DataRoot = None,
    camera: Camera = None,
    as_json: AsJson = False,
) -> None:
    """Show the facts of a sequence, and its contents if it is on this machine."""
    from dynslam_bench.sequences.catalogue import describe

    facts: dict[str, Any] = describe(name, data_root=data_root, camera=camera)
    present(facts, lambda: write_fields(facts))


@app.command()
def fetch(
    names: Annotated[
        list[str], typer.Argument(help="Ids or patterns such as 'bonn/*'.", autocompletion=complete_sequences)
    ],
    data_root: DataRoot = None,
    url: Annotated[Optional[str], typer.Option(help="A mirror's address of the archive.")] = None,  # noqa: UP045
    checksum: Annotated[bool, typer.Option(help="Refuse an archive whose checksum is not the known one.")] = True,
    keep_archive: Annotated[bool, typer.Option("--keep-archive", help="Keep the archive, too.")] = False,
) -> None:
    """Download public sequences; a call that was cut short goes on where it stopped."""
    from dynslam_bench.sequences.catalogue import expand
    from dynslam_bench.sequences.fetch import RECEIPT, Receipt, status
    from dynslam_bench.sequences.fetch import fetch as fetch_one

    for name in expand(names):
        new = status(name, data_root=data_root) is None
        with progress(name, unit="bytes") as advance:
            place = fetch_one(
                name,
                data_root=data_root,
                progress=lambda state, advance=advance: advance(state.done, state.total),  # type: ignore[misc]
                checksum=checksum,
                keep_archive=keep_archive,
                url=url,
            )
        write(str(place))
        if new and not (receipt := Receipt.read(place / RECEIPT)).checked:
            warn(
                f"warning: no checksum of {name} is published; that of this archive is {receipt.sha256}, "
                "and the next fetch from there has to have the same"
            )


@app.command()
def verify(
    names: Annotated[list[str], typer.Argument(help="Ids, patterns or paths.", autocompletion=complete_sequences)],
    data_root: DataRoot = None,
    camera: Camera = None,
    as_json: AsJson = False,
) -> None:
    """Decode every frame, and compare every file with the checksum taken when it was fetched."""
    from dynslam_bench.sequences.catalogue import expand
    from dynslam_bench.sequences.fetch import verify as verify_one

    reports = []
    for name in expand(names):
        with progress(name) as advance:
            reports.append(verify_one(name, data_root=data_root, camera=camera, progress=advance))

    def show() -> None:
        for report in reports:
            verdict = "ok" if report.ok else f"{len(report.faults)} faults"
            how = "every file as fetched" if report.manifest else "not fetched by this program, frames decoded only"
            write(f"{report.id}: {verdict}, {report.frames} frames, {how}")
            dropped = [] if report.dropped is None else [report.dropped.describe()]
            for line in (*dropped, *report.faults):
                write(f"  {line}")

    present([{**asdict(report), "ok": report.ok} for report in reports], show)
    if not all(report.ok for report in reports):
        raise typer.Exit(VERIFICATION_FAILED)


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

    def show() -> None:
        faults = sum(finding.severity == "fault" for finding in diagnosis.findings)
        verdict = "no fault found" if diagnosis.ok else f"{faults} fault{'s' * (faults != 1)}"
        write(f"{diagnosis.id}: {verdict}, {diagnosis.frames} frames compared")
        for finding in diagnosis.findings:
            write(f"  {finding.severity} {finding.id}: {finding.text}\n    cure: {finding.cure}")

    present({**asdict(diagnosis), "ok": diagnosis.ok}, show)
    if not diagnosis.ok:
        raise typer.Exit(VERIFICATION_FAILED)


@app.command()
def unpack(
    bag: Annotated[Path, typer.Argument(help="A ROS 1 .bag, a ROS 2 folder, an .mcap or .db3 file.")],
    folder: Annotated[Path, typer.Argument(help="The folder to make, in TUM layout.")],
    colour: Annotated[Optional[str], typer.Option(help="Topic of the colour images.")] = None,  # noqa: UP045
    depth: Annotated[Optional[str], typer.Option(help="Topic of registered depth images.")] = None,  # noqa: UP045
    truth: Annotated[Optional[str], typer.Option(help="Topic of the camera's true poses, or none.")] = None,  # noqa: UP045
    as_json: AsJson = False,
) -> None:
    """Unpack a ROS bag or MCAP file into a folder that is a sequence."""
    from dynslam_bench.sequences.bags import unpack_bag

    unpacked = unpack_bag(bag, folder, colour=colour, depth=depth, truth=truth)

    def show() -> None:
        for line in unpacked.notes:
            note(line)
        poses = f", poses from {unpacked.truth}" if unpacked.truth else ", no ground truth"
        write(f"{unpacked.folder}: {unpacked.frames} frames from {unpacked.colour} and {unpacked.depth}{poses}")

    present({**asdict(unpacked), "folder": str(unpacked.folder)}, show)


@app.command()
def render(
    names: Annotated[list[str], typer.Argument(help="Such as 'synthetic/walking_xyz?scene=0&frames=600'.")],
    data_root: DataRoot = None,
    threads: Annotated[Optional[int], typer.Option(min=1, help="Frames rendered at a time.")] = None,  # noqa: UP045
) -> None:
    """Render sequences now, in place of when they are first read."""
    from dynslam_bench.core.folders import find_data_root
    from dynslam_bench.sequences.synthetic import render_synthetic

    for name in names:
        with progress(name) as advance:
            folder = render_synthetic(name, find_data_root(data_root), threads=threads, progress=advance)
        note(f"{name} is in")
        write(str(folder))


@app.command()
def calibrate(
    name: Annotated[str, typer.Argument(help="Path or id of a recording.", autocompletion=complete_sequences)],
    data_root: DataRoot = None,
    camera: Camera = None,
    frames: Frames = None,
    output: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Write the camera, with what was measured, to this camera.toml."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure the readout time of a rolling shutter, the delay of depth, and the depth factor."""
    from dynslam_bench.sequences.calibration import calibrate as measure
    from dynslam_bench.sequences.cameras import write_camera
    from dynslam_bench.sequences.catalogue import open_sequence

    sequence = open_sequence(name, data_root=data_root, camera=camera, frames=frames)
    with progress(name) as advance:
        result = measure(sequence, progress=advance)
    written = output is not None and result.measured
    if output is not None and written:
        write_camera(output, result.camera, fps=sequence.fps)

    def show() -> None:
        write_table(
            ("quantity", "estimate", "95 % interval", "camera.toml", "why"), list(map(_calibrated, result.quantities))
        )
        write(f"{result.windows} windows of {result.frames} frames, keypoints to {result.pixel_noise:.2f} px")
        if written:
            write(str(output))
        elif output is not None:
            note(f"nothing to write: {output} is left alone")

    present({**asdict(result), "file": str(output) if written else None}, show)


def _calibrated(quantity: Any) -> tuple[str, ...]:
    """A row of the table of `calibrate`."""
    scale, unit = (1.0, "a metre") if quantity.name == "depth_factor" else (1e3, "ms")
    value, low, high = (
        None if v is None else f"{scale * v:.4g}" for v in (quantity.value, quantity.low, quantity.high)
    )
    interval = "" if low is None or high is None else f"{low} to {high}"
    verdict = "kept" if quantity.written is None else f"{quantity.written:g}"
    verdict = verdict if quantity.observable else "not observable"
    return quantity.name, "" if value is None else f"{value} {unit}", interval, verdict, quantity.reason
