"""``sequences list|info|fetch|verify|doctor|calibrate|unpack|render``."""

from __future__ import annotations

import fnmatch
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from dynslam_bench.cli import options as completion
from dynslam_bench.cli.options import AsJson, Camera, DataRoot, Frames
from dynslam_bench.cli.output import (
    VERIFICATION_FAILED,
    complain,
    note,
    progress,
    write,
    write_fields,
    write_json,
    write_table,
)

if TYPE_CHECKING:
    from dynslam_bench.sequences.catalogue import Summary

app = typer.Typer(help="Find, fetch, check and render sequences.", no_args_is_help=True)


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
    tags = sorted({each for summary in everything for each in summary.tags})
    if tag is not None and tag not in tags:
        raise SequenceError(f"no sequence has the tag '{tag}'", f"known: {', '.join(tags)}")
    if not any(fnmatch.fnmatch(each.id, pattern) for each in everything):
        folder = f"{pattern.rstrip('/')}/*"
        pattern = folder if any(fnmatch.fnmatch(each.id, folder) for each in everything) else pattern
    if not any(fnmatch.fnmatch(each.id, pattern) for each in everything):
        raise SequenceError(f"no sequence matches '{pattern}'", did_you_mean(pattern, [each.id for each in everything]))
    found = [
        each
        for each in everything
        if fnmatch.fnmatch(each.id, pattern) and (tag is None or tag in each.tags) and (each.here or not here)
    ]
    if as_json:
        write_json([asdict(each) for each in found])
    elif not found:
        asked = [f"'{pattern}'", *([f"with the tag {tag}"] if tag else []), *(["on this machine"] if here else [])]
        write(f"no sequence matches {' '.join(asked)}; all {len(everything)}: dynslam-bench sequences list")
    for title, group in groupby([] if as_json else found, key=lambda each: each.dataset):
        _write_group(title, list(group))


def _write_group(title: str, found: list[Summary]) -> None:
    """A data set's sequences under a line of what holds for all of them."""
    count = f"{len(found)} listed, {sum(each.here for each in found)} here"
    layout, by_hand = found[0].layout, found[0].by_hand
    about = [count, f"licence: {found[0].license}", f"layout: {layout} on the publisher's files" if layout else ""]
    write(f"{title} ({'; '.join(filter(None, (*about, f'by hand: {by_hand}' if by_hand else '')))})")
    write_table(
        ("sequence", "here", "size", "tags", "split", "ground truth", "checksum"),
        [(each.id, each.here, each.size, each.tags, each.split, each.ground_truth, each.checksum) for each in found],
        spare=("checksum", "ground truth", "split"),
    )
    write("")


@app.command()
def info(
    name: Annotated[
        str, typer.Argument(help="Id, published folder name or path.", autocompletion=completion.sequences)
    ],
    data_root: DataRoot = None,
    camera: Camera = None,
    as_json: AsJson = False,
) -> None:
    """Show what is known of a sequence, and what it holds if it is on this machine."""
    from dynslam_bench.sequences.catalogue import describe

    found: dict[str, Any] = describe(name, data_root=data_root, camera=camera)
    if as_json:
        write_json(found)
    else:
        write_fields(found)


@app.command()
def fetch(
    names: Annotated[
        list[str], typer.Argument(help="Ids or patterns such as 'bonn/*'.", autocompletion=completion.sequences)
    ],
    data_root: DataRoot = None,
    url: Annotated[Optional[str], typer.Option(help="A mirror's address of the archive.")] = None,  # noqa: UP045
    checksum: Annotated[bool, typer.Option(help="Refuse an archive whose checksum is not the known one.")] = True,
    keep_archive: Annotated[bool, typer.Option("--keep-archive", help="Keep the archive, too.")] = False,
) -> None:
    """Download public sequences; a call that was cut short goes on where it stopped."""
    from dynslam_bench.core.download import Progress
    from dynslam_bench.sequences.catalogue import expand
    from dynslam_bench.sequences.fetch import RECEIPT, Receipt, status
    from dynslam_bench.sequences.fetch import fetch as fetch_one

    for name in expand(names):
        new = status(name, data_root=data_root).folder is None
        with progress(name, unit="bytes") as advance:

            def report(state: Progress, advance: Any = advance) -> None:
                advance(state.done, state.total)

            place = fetch_one(
                name, data_root=data_root, progress=report, checksum=checksum, keep_archive=keep_archive, url=url
            )
        write(str(place))
        if new and not (receipt := Receipt.read(place / RECEIPT)).checked:
            complain(
                f"warning: no checksum of {name} was known; that of what came is {receipt.sha256}, "
                "and the next fetch from there has to bring the same"
            )


@app.command()
def verify(
    names: Annotated[list[str], typer.Argument(help="Ids, patterns or paths.", autocompletion=completion.sequences)],
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
    if as_json:
        write_json([{**asdict(report), "ok": report.ok} for report in reports])
    else:
        for report in reports:
            compared = (
                "every file as fetched" if report.manifest else "not fetched by this program, frames decoded only"
            )
            verdict = "ok" if report.ok else f"{len(report.faults)} faults"
            write(f"{report.id}: {verdict}, {report.frames} frames, {compared}")
            if report.dropped is not None:
                write(f"  {report.dropped.describe()}")
            for fault in report.faults:
                write(f"  {fault}")
    if not all(report.ok for report in reports):
        raise typer.Exit(VERIFICATION_FAILED)


@app.command()
def doctor(
    name: Annotated[
        str, typer.Argument(help="Id, published folder name or path.", autocompletion=completion.sequences)
    ],
    data_root: DataRoot = None,
    camera: Camera = None,
    as_json: AsJson = False,
) -> None:
    """Compare a recording's images with its camera and its truth; exits with 4 where a fault was found."""
    from dynslam_bench.sequences.doctor import diagnose

    with progress(name) as advance:
        diagnosis = diagnose(name, data_root=data_root, camera=camera, progress=advance)
    if as_json:
        write_json({**asdict(diagnosis), "ok": diagnosis.ok, "verdict": diagnosis.verdict})
    else:
        frames = f"{diagnosis.frames} frame{'s' * (diagnosis.frames != 1)}"
        write(f"{diagnosis.id}: {diagnosis.verdict} ({frames} read)")
        for finding in diagnosis.findings:
            write(f"  {finding.severity} {finding.id}: {finding.text}")
            write(f"    cure: {finding.cure}")
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

    found = unpack_bag(bag, folder, colour=colour, depth=depth, truth=truth)
    if as_json:
        write_json({**asdict(found), "folder": str(found.folder)})
        return
    for line in found.notes:
        note(line)
    poses = f", poses from {found.truth}" if found.truth else ", no ground truth"
    write(f"{found.folder}: {found.frames} frames from {found.colour} and {found.depth}{poses}")


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
    name: Annotated[str, typer.Argument(help="Path or id of a recording.", autocompletion=completion.sequences)],
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
        found = measure(sequence, progress=advance)
    written = output is not None and found.measured
    if output is not None and written:
        write_camera(output, found.camera, fps=sequence.fps)
    if as_json:
        write_json({**asdict(found), "file": str(output) if written else None})
        return
    units = {"readout_s": (1e3, "ms"), "depth_delay_s": (1e3, "ms"), "depth_factor": (1.0, "a metre")}
    rows = []
    for each in found.quantities:
        scale, unit = units[each.name]
        estimate = "" if each.value is None else f"{scale * each.value:.4g} {unit}"
        interval = "" if each.low is None or each.high is None else f"{scale * each.low:.4g} to {scale * each.high:.4g}"
        verdict = "not observable" if not each.observable else "kept" if each.written is None else f"{each.written:g}"
        rows.append((each.name, estimate, interval, verdict, each.reason))
    write_table(("quantity", "estimate", "95 % interval", "camera.toml", "why"), rows)
    write(f"{found.windows} windows of {found.frames} frames, keypoints to {found.pixel_noise:.2f} px")
    if written:
        write(f"{output}")
    elif output is not None:
        note(f"nothing to write: {output} is left alone")
