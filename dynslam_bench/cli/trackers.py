"""``trackers list|info|doctor|test|new``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dynslam_bench.cli import options as completion
from dynslam_bench.cli.options import AsJson, Assignments, MemoryLimit, SettingsFile, gather_settings
from dynslam_bench.cli.output import VERIFICATION_FAILED, heartbeat, write, write_fields, write_json, write_table

if TYPE_CHECKING:
    from dynslam_bench.core.settings import Settings
    from dynslam_bench.trackers import TrackerSpec

Tracker = Annotated[str, typer.Argument(help="Id, module:Attr or file.py:Attr.", autocompletion=completion.trackers)]

app = typer.Typer(help="Trackers: what there is, why one is missing, how to make one.", no_args_is_help=True)


@app.command("list")
def list_(as_json: AsJson = False) -> None:
    """List all trackers, those included that lack a package."""
    from dynslam_bench.trackers import TRACKERS

    rows: list[dict[str, Any]] = [
        {
            "id": found.spec.id,
            "label": found.spec.label,
            "sensors": found.spec.sensors,
            "provenance": found.spec.provenance,
            "ranked": found.spec.ranked,
            "available": not found.spec.missing(),
            "install": found.spec.missing(),
            "source": found.source,
            "summary": found.spec.summary,
        }
        for found in TRACKERS.all()
    ]
    if as_json:
        write_json(rows)
        return
    columns = ("id", "sensors", "provenance", "ranked", "available", "summary")
    write_table(columns, [[row[column] for column in columns] for row in rows], shrink=("summary",))


@app.command()
def info(
    tracker: Tracker,
    as_json: AsJson = False,
) -> None:
    """Show a tracker's description, its settings and its published numbers."""
    from dynslam_bench.core.settings import flatten, settings_table
    from dynslam_bench.trackers import TRACKERS
    from dynslam_bench.trackers.registry import epipolar_skipped

    spec = TRACKERS.get(tracker)
    numbers = _published(spec)
    facts: dict[str, Any] = {
        "id": spec.id,
        "label": spec.label,
        "summary": spec.summary,
        "provenance": spec.provenance,
        "ranked": spec.ranked,
        "sensors": spec.sensors,
        "deterministic": spec.deterministic,
        "version": spec.version,
        "license": spec.license,
        "citation": spec.citation,
        "entry_point": spec.entry_point,
        "install": spec.missing(),
        "presets": {name: dict(values) for name, values in spec.presets.items()},
        "assumptions": list(spec.assumptions),
        "remarks": spec.remarks,
    }
    skipped = epipolar_skipped(spec.id)
    if as_json:
        described = parameter_facts(spec.settings)
        facts |= {"epipolar_skipped": skipped, "settings": flatten(spec.settings()), "parameters": described}
        write_json({**facts, "reported": numbers})
        return
    facts["presets"] = [f"{name} ({_assigned(values)})" for name, values in spec.presets.items()]
    if skipped:
        facts["epipolar_skipped"] = [f"{100 * share:.0f} % of {where}" for where, share in skipped.items()]
    write_fields(facts)
    write()
    write(settings_table(spec.settings).rstrip())
    if numbers:
        write()
        write_table(
            ("sequence", "reported metric", "value", "source", "remarks"), [tuple(row.values()) for row in numbers]
        )


def _assigned(values: Mapping[str, Any]) -> str:
    """Settings as ``--set`` takes them."""
    from dynslam_bench.core.toml import assignments

    return ", ".join(assignments(values))


def parameter_facts(settings: type[Settings]) -> list[dict[str, Any]]:
    """Every setting with its default; of those that studies may tune also what they need to know."""
    from dataclasses import asdict

    from dynslam_bench.core.settings import flatten, parameters

    tunable = {parameter.name: asdict(parameter) for parameter in parameters(settings)}
    return [
        {"name": name, "default": default, "tunable": name in tunable, "online": False} | tunable.get(name, {})
        for name, default in flatten(settings()).items()
    ]


def _published(spec: TrackerSpec) -> list[dict[str, Any]]:
    """What others report of a system: its own spec's numbers, the published ones and those that the paper claims."""
    from dynslam_bench.reports.model.published import CLAIMED, claimed, published

    own = [
        (name, metric, value, "its spec", "") for name, row in spec.reported.items() for metric, value in row.items()
    ]
    read = [
        (p.sequence, p.metric, p.value, p.source, "; ".join(filter(None, (p.alignment, p.remarks))))
        for p in published().itertuples()
        if p.system in spec.published_as
    ]
    paper = [
        (c.sequence, c.quantity, c.value, f"EMFOA-OFT-SLAM, table {c.table}", f"{CLAIMED}: see 'report audit-paper'")
        for c in claimed().itertuples()
        if c.system in spec.published_as and c.kind == "value"
    ]
    names = ("sequence", "metric", "value", "source", "remarks")
    return [dict(zip(names, row, strict=True)) for row in own + read + paper]


@app.command()
def doctor(as_json: AsJson = False) -> None:
    """Say which plug-ins are not available, and why."""
    from dynslam_bench.testing.installation import diagnose

    found = diagnose()
    if as_json:
        write_json([each.__dict__ for each in found])
        return
    if not found:
        write("all plug-ins are available")
    for each in found:
        write(f"{each.kind}: {each.name}: {each.reason}")


@app.command()
def test(
    tracker: Tracker,
    assignments: Assignments = None,
    settings: SettingsFile = None,
    frames: Annotated[int, typer.Option(min=2, help="Frames of each check.")] = 6,
    time_limit: Annotated[
        float, typer.Option(min=0.1, help="Seconds for a frame or another step; five times that for the first.")
    ] = 60.0,
    memory_limit: MemoryLimit = None,
    as_json: AsJson = False,
) -> None:
    """Check that a tracker keeps its contract, in a process of its own."""
    from dynslam_bench.testing import Check, isolated_tracker_report

    def told(check: Check) -> None:
        if not as_json:
            write(f"{check.status:8}{check.name}" + (f": {check.message}" if check.message else ""), now=True)

    with heartbeat() as beat:
        report = isolated_tracker_report(
            tracker,
            settings=gather_settings(assignments, settings, {}),
            frames=frames,
            frame_s=time_limit,
            start_s=5 * time_limit,
            memory_mb=memory_limit,
            on_check=told,
            on_wait=lambda running: beat(f"checking: {running}"),
        )
    if as_json:
        write_json({"subject": report.subject, "ok": report.ok, "checks": [check.__dict__ for check in report.checks]})
    else:
        write(f"{report.subject}: {len(report.failed)} of {len(report.checks)} checks failed")
    if not report.ok:
        raise typer.Exit(VERIFICATION_FAILED)


@app.command()
def new(
    name: Annotated[str, typer.Argument(help="Name of the tracker, e.g. my-slam.")],
    folder: Annotated[Path, typer.Option("--dir", help="Where to put the file.")] = Path(),
) -> None:
    """Write a tracker to start from: one file that already runs."""
    from dynslam_bench.testing.template import write_tracker_template

    path = write_tracker_template(name, folder)
    shown = path if path.is_absolute() or str(path).startswith(".") else f"./{path}"
    write(str(path))
    write(f"check it:  dynslam-bench trackers test {shown}:SPEC")
    write(f"run it:    dynslam-bench run {shown}:SPEC synthetic/walking_xyz --frames 0:100")
    write(f'list it:   export DYNSLAM_BENCH_PLUGINS="trackers={path.absolute()}:SPEC"')
