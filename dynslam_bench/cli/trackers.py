"""``trackers list|info|doctor|test|new``."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from textwrap import shorten
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
from dynslam_bench.cli.output import fields, json_mode, present, progress, table, wrapped, write

if TYPE_CHECKING:
    from dynslam_bench.core.settings import Parameter
    from dynslam_bench.testing import Check
    from dynslam_bench.trackers import TrackerSpec

Tracker = Annotated[
    str, typer.Argument(help="Id, module:Attr or file.py:Attr.", autocompletion=complete_trackers)
]

app = typer.Typer(
    help="Trackers: what there is, why one is missing, how to make one.", no_args_is_help=True
)


@app.command("list")
def list_(as_json: AsJson = False) -> None:
    """List all trackers by kind, those included that lack a package; variants stand below their tracker."""
    from dynslam_bench.trackers.registry import TRACKERS, tracker_groups

    rows = [
        {
            "id": tracker.spec.id,
            "label": tracker.spec.label,
            "sensors": tracker.spec.sensors,
            "provenance": tracker.spec.provenance,
            "ranked": tracker.spec.ranked,
            "available": not tracker.spec.missing(),
            "install": tracker.spec.missing(),
            "source": tracker.source,
            "summary": tracker.spec.summary,
        }
        for tracker in TRACKERS.all()
    ]
    lines = []
    for kind, families in tracker_groups().items():
        lines += [f"{kind}:"] if families else []
        for spec, *variants in families:
            lines.append(
                f"  {spec.id:18} {spec.label}{'' if spec.missing() == [] else ' (not installed)'}"
            )
            if variants:
                lines.append(
                    f"  {'':18} {'  '.join(variant.id.removeprefix(spec.id) for variant in variants)}"
                )
    present(rows, *lines)


@app.command()
def info(tracker: Tracker, as_json: AsJson = False) -> None:
    """Show a tracker's description and its tunable settings; --json has all settings and the published numbers."""
    from dynslam_bench.core import assignments
    from dynslam_bench.core.settings import flatten, parameters
    from dynslam_bench.trackers import TRACKERS

    spec = TRACKERS.get(tracker)
    reported = _published(spec)
    defaults = flatten(spec.settings())
    shown = parameters(spec.settings)
    shown += [
        parameter
        for parameter in parameters(spec.settings, online_only=True)
        if not parameter.tunable
    ]
    described = {parameter.name: asdict(parameter) for parameter in shown}
    facts: dict[str, Any] = {
        "id": spec.id,
        "label": spec.label,
        "summary": spec.summary,
        "provenance": spec.provenance,
        "sensors": spec.sensors,
        "citation": spec.citation,
        "install": spec.missing(),
    }
    details = {
        "ranked": spec.ranked,
        "deterministic": spec.deterministic,
        "version": spec.version,
        "license": spec.license,
        "entry_point": spec.entry_point,
        "presets": spec.presets,
        "assumptions": spec.assumptions,
        "remarks": spec.remarks,
        "settings": defaults,
        "parameters": [
            {"name": name, "default": default, "tunable": False, "online": False}
            | described.get(name, {})
            for name, default in defaults.items()
        ],
        "reported": reported,
    }
    fixed = len(defaults) - len(shown)
    sources = [
        f"{source} ({count})"
        for source, count in Counter(row["source"] for row in reported).items()
    ]
    rows = [(p.name, p.default, range_text(p), p.unit, p.online, p.meaning) for p in shown]
    present(
        facts | details,
        fields(
            facts
            | {
                f"preset {name}": ", ".join(assignments(values))
                for name, values in spec.presets.items()
            }
        ),
        *(
            [table(("setting", "default", "range", "unit", "online", "meaning"), rows)]
            if rows
            else []
        ),
        *([f"and {fixed} more settings that no study tunes: see --json"] if fixed else []),
        *(
            [wrapped(f"numbers reported in: {', '.join(sources)}; --json lists them")]
            if sources
            else []
        ),
    )


def range_text(parameter: Parameter) -> str:
    """The values that a study may give a setting."""
    if parameter.choices:
        return shorten(", ".join(map(str, parameter.choices)), 50, placeholder=" ...")
    return f"{parameter.low:g} to {parameter.high:g}{' (log)' if parameter.scale == 'log' else ''}"


def _published(spec: TrackerSpec) -> list[dict[str, Any]]:
    """The reported numbers of a system: those of its spec, of publications, and the claims of the paper."""
    from dynslam_bench.reports.model.published import CLAIMED, claimed_results, published

    stated = [
        (name, metric, value, "its spec", "")
        for name, row in spec.reported.items()
        for metric, value in row.items()
    ]
    measured = [
        (
            p.sequence,
            p.metric,
            p.value,
            p.source,
            "; ".join(str(text) for text in (p.alignment, p.remarks) if text),
        )
        for p in published().itertuples()
        if p.system in spec.published_as
    ]
    paper = [
        (
            c.sequence,
            c.quantity,
            c.value,
            f"EMFOA-OFT-SLAM, table {c.table}",
            f"{CLAIMED}: see 'report audit-paper'",
        )
        for c in claimed_results().itertuples()
        if c.system in spec.published_as and c.kind == "value"
    ]
    names = ("sequence", "metric", "value", "source", "remarks")
    return [dict(zip(names, row, strict=True)) for row in stated + measured + paper]


@app.command()
def doctor(as_json: AsJson = False) -> None:
    """Show which plug-ins are not available, and why."""
    from dynslam_bench.testing.installation import unavailable_plugins

    plugins = unavailable_plugins()
    present(
        plugins,
        *(
            [f"{plugin.name}: {plugin.hint}" for plugin in plugins]
            or ["all plug-ins are available"]
        ),
    )


@app.command()
def test(
    tracker: Tracker,
    assignments: Assignments = None,
    settings: SettingsFile = None,
    frames: Annotated[int, typer.Option(min=2, help="Frames of each check.")] = 6,
    time_limit: Annotated[
        float,
        typer.Option(
            min=0.1, help="Seconds for a frame or another step; five times that for the first."
        ),
    ] = 60.0,
    memory_limit: MemoryLimit = None,
    as_json: AsJson = False,
) -> None:
    """Check that a tracker keeps its contract, in a child process."""
    from dynslam_bench.testing import isolated_tracker_report

    def on_check(check: Check) -> None:
        if not json_mode():
            write(f"{check.status:8}{check.name}" + (f": {check.message}" if check.message else ""))

    with progress("checking") as advance:
        report = isolated_tracker_report(
            tracker,
            settings=gather_settings(assignments, settings),
            frames=frames,
            frame_s=time_limit,
            start_s=5 * time_limit,
            memory_mb=memory_limit,
            on_check=on_check,
            on_wait=lambda check: advance(0, None, check),
        )
    present(
        {"subject": report.subject, "ok": report.ok, "checks": report.checks},
        f"{report.subject}: {len(report.failed)} of {len(report.checks)} checks failed",
        verified=report.ok,
    )


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
