"""``trackers list|info|doctor|test|new``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dynslam_bench.cli.options import (
    AsJson,
    Assignments,
    MemoryLimit,
    SettingsFile,
    complete_trackers,
    gather_settings,
)
from dynslam_bench.cli.output import (
    VERIFICATION_FAILED,
    heartbeat,
    json_mode,
    present,
    write,
    write_fields,
    write_table,
)

if TYPE_CHECKING:
    from dynslam_bench.core.settings import Settings
    from dynslam_bench.testing import Check
    from dynslam_bench.trackers import TrackerSpec

Tracker = Annotated[str, typer.Argument(help="Id, module:Attr or file.py:Attr.", autocompletion=complete_trackers)]

app = typer.Typer(help="Trackers: what there is, why one is missing, how to make one.", no_args_is_help=True)


@app.command("list")
def list_(as_json: AsJson = False) -> None:
    """List all trackers by kind, those included that lack a package; variants stand below their tracker."""
    from dynslam_bench.trackers.registry import TRACKERS, tracker_groups

    sources = {tracker.spec.id: tracker.source for tracker in TRACKERS.all()}

    def show() -> None:
        for kind, families in tracker_groups().items():
            if families:
                write(f"{kind}:")
            for spec, *variants in families:
                write(f"  {spec.id:18} {spec.label}{'' if spec.missing() == [] else ' (not installed)'}")
                if variants:
                    write(f"  {'':18} {'  '.join(variant.id.removeprefix(spec.id) for variant in variants)}")

    rows = [
        {
            "id": spec.id,
            "label": spec.label,
            "sensors": spec.sensors,
            "provenance": spec.provenance,
            "ranked": spec.ranked,
            "available": not spec.missing(),
            "install": spec.missing(),
            "source": sources[spec.id],
            "summary": spec.summary,
        }
        for spec in (tracker.spec for tracker in TRACKERS.all())
    ]
    present(rows, show)


@app.command()
def info(tracker: Tracker, as_json: AsJson = False) -> None:
    """Show a tracker's description, its settings and its published numbers."""
    from dynslam_bench.core.settings import flatten, settings_table
    from dynslam_bench.core.toml import assignments
    from dynslam_bench.trackers.registry import TRACKERS, epipolar_skipped

    spec = TRACKERS.get(tracker)
    numbers, skipped = _published(spec), epipolar_skipped(spec.id)
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
        "epipolar_skipped": skipped,
    }

    def show() -> None:
        presets = [f"{name} ({', '.join(assignments(values))})" for name, values in spec.presets.items()]
        shares = [f"{100 * share:.0f} % of {sequence}" for sequence, share in skipped.items()]
        write_fields(facts | {"presets": presets, "epipolar_skipped": shares})
        write(f"\n{settings_table(spec.settings).rstrip()}")
        if numbers:
            write()
            columns = ("sequence", "reported metric", "value", "source", "remarks")
            write_table(columns, [tuple(row.values()) for row in numbers])

    details = {"settings": flatten(spec.settings()), "parameters": parameter_facts(spec.settings), "reported": numbers}
    present(facts | details, show)


def parameter_facts(settings: type[Settings]) -> list[dict[str, Any]]:
    """Every setting with its default; the tunable ones also with range, scale, unit and meaning."""
    from dynslam_bench.core.settings import flatten, parameters

    tunable = {parameter.name: asdict(parameter) for parameter in parameters(settings)}
    return [
        {"name": name, "default": default, "tunable": name in tunable, "online": False} | tunable.get(name, {})
        for name, default in flatten(settings()).items()
    ]


def _published(spec: TrackerSpec) -> list[dict[str, Any]]:
    """The reported numbers of a system: those of its spec, of publications, and the claims of the paper."""
    from dynslam_bench.reports.model.published import CLAIMED, claimed, published

    stated = [
        (name, metric, value, "its spec", "") for name, row in spec.reported.items() for metric, value in row.items()
    ]
    measured = [
        (p.sequence, p.metric, p.value, p.source, "; ".join(str(text) for text in (p.alignment, p.remarks) if text))
        for p in published().itertuples()
        if p.system in spec.published_as
    ]
    paper = [
        (c.sequence, c.quantity, c.value, f"EMFOA-OFT-SLAM, table {c.table}", f"{CLAIMED}: see 'report audit-paper'")
        for c in claimed().itertuples()
        if c.system in spec.published_as and c.kind == "value"
    ]
    names = ("sequence", "metric", "value", "source", "remarks")
    return [dict(zip(names, row, strict=True)) for row in stated + measured + paper]


@app.command()
def doctor(as_json: AsJson = False) -> None:
    """Show which plug-ins are not available, and why."""
    from dynslam_bench.testing.installation import unavailable_plugins

    plugins = unavailable_plugins()
    lines = [f"{plugin.kind}: {plugin.name}: {plugin.reason}" for plugin in plugins]
    present([asdict(plugin) for plugin in plugins], lambda: write("\n".join(lines or ["all plug-ins are available"])))


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
    """Check that a tracker keeps its contract, in a child process."""
    from dynslam_bench.testing import isolated_tracker_report

    def on_check(check: Check) -> None:
        if not json_mode():
            write(f"{check.status:8}{check.name}" + (f": {check.message}" if check.message else ""), now=True)

    with heartbeat() as beat:
        report = isolated_tracker_report(
            tracker,
            settings=gather_settings(assignments, settings),
            frames=frames,
            frame_s=time_limit,
            start_s=5 * time_limit,
            memory_mb=memory_limit,
            on_check=on_check,
            on_wait=lambda check: beat(f"checking: {check}"),
        )
    facts = {"subject": report.subject, "ok": report.ok, "checks": [asdict(check) for check in report.checks]}
    total = f"{report.subject}: {len(report.failed)} of {len(report.checks)} checks failed"
    present(facts, lambda: write(total))
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
