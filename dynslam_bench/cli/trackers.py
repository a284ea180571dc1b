"""``trackers list|info|doctor|test|new``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
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
        if families:
            lines.append(f"{kind}:")
        for spec, *variants in families:
            missing = "" if spec.missing() == [] else " (not installed)"
            lines.append(f"  {spec.id:18} {spec.label}{missing}")
            if variants:
                # `?masks=none` of `emfoa-oft?masks=none`
                endings = "  ".join(variant.id.removeprefix(spec.id) for variant in variants)
                lines.append(f"  {'':18} {endings}")
    present(rows, *lines)


@app.command()
def info(tracker: Tracker, as_json: AsJson = False) -> None:
    """Show a tracker's description and its tunable settings; --json has all settings and the published numbers."""
    from dynslam_bench.core import assignments
    from dynslam_bench.core.settings import flatten, parameters
    from dynslam_bench.trackers import TRACKERS

    spec = TRACKERS.get(tracker)
    reported = _reported_numbers(spec)
    defaults = flatten(spec.settings())
    # settings that a study tunes, then those that only an agent changes at a frame
    shown = parameters(spec.settings)
    online = parameters(spec.settings, online_only=True)
    shown += [parameter for parameter in online if not parameter.tunable]
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
        "parameters": _all_parameters(defaults, shown),
        "reported": reported,
    }

    presets = {
        f"preset {name}": ", ".join(assignments(values)) for name, values in spec.presets.items()
    }
    lines = [fields(facts | presets)]
    if shown:
        columns = ("setting", "default", "range", "unit", "online", "meaning")
        rows = [(p.name, p.default, range_text(p), p.unit, p.online, p.meaning) for p in shown]
        lines.append(table(columns, rows))
    fixed = len(defaults) - len(shown)
    if fixed:
        lines.append(f"and {fixed} more settings that no study tunes: see --json")
    if reported:
        counts = Counter(row["source"] for row in reported)
        sources = ", ".join(f"{source} ({count})" for source, count in counts.items())
        lines.append(wrapped(f"numbers reported in: {sources}; --json lists them"))
    present(facts | details, *lines)


def _all_parameters(
    defaults: Mapping[str, Any], described: Sequence[Parameter]
) -> list[dict[str, Any]]:
    """All settings for JSON: with range, unit and meaning if they are described, else with their default alone."""
    descriptions = {parameter.name: asdict(parameter) for parameter in described}
    rows = []
    for name, default in defaults.items():
        row = {"name": name, "default": default, "tunable": False, "online": False}
        rows.append(row | descriptions.get(name, {}))
    return rows


def range_text(parameter: Parameter) -> str:
    """The values that a study may give a setting."""
    if parameter.choices:
        return shorten(", ".join(map(str, parameter.choices)), 50, placeholder=" ...")
    scale = " (log)" if parameter.scale == "log" else ""
    return f"{parameter.low:g} to {parameter.high:g}{scale}"


def _reported_numbers(spec: TrackerSpec) -> list[dict[str, Any]]:
    """The reported numbers of a system: those of its spec, of publications, and the claims of the paper."""
    from dynslam_bench.reports.model.published import CLAIMED, claimed_results, published

    rows: list[tuple[Any, ...]] = []
    for sequence, values in spec.reported.items():
        rows += [(sequence, metric, value, "its spec", "") for metric, value in values.items()]
    for number in published().itertuples():
        if number.system in spec.published_as:
            remarks = "; ".join(str(text) for text in (number.alignment, number.remarks) if text)
            rows.append((number.sequence, number.metric, number.value, number.source, remarks))
    for claim in claimed_results().itertuples():
        if claim.system in spec.published_as and claim.kind == "value":
            source = f"EMFOA-OFT-SLAM, table {claim.table}"
            remarks = f"{CLAIMED}: see 'report audit-paper'"
            rows.append((claim.sequence, claim.quantity, claim.value, source, remarks))
    names = ("sequence", "metric", "value", "source", "remarks")
    return [dict(zip(names, row, strict=True)) for row in rows]


@app.command()
def doctor(as_json: AsJson = False) -> None:
    """Show which plug-ins are not available, and why."""
    from dynslam_bench.testing.installation import unavailable_plugins

    plugins = unavailable_plugins()
    lines = [f"{plugin.name}: {plugin.hint}" for plugin in plugins]
    present(plugins, *(lines or ["all plug-ins are available"]))


@app.command()
def test(
    tracker: Tracker,
    set_options: Assignments = None,
    settings_file: SettingsFile = None,
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
        if json_mode():
            return
        message = f": {check.message}" if check.message else ""
        write(f"{check.status:8}{check.name}{message}")

    with progress("checking") as advance:
        report = isolated_tracker_report(
            tracker,
            settings=gather_settings(set_options, settings_file),
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
