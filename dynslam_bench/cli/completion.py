"""What the shell offers when one presses Tab: trackers, sequences, settings, presets, suites, protocols and tags."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from dynslam_bench.core.errors import DynslamError

if TYPE_CHECKING:
    from dynslam_bench.contracts.tracker import TrackerSpec


def trackers(incomplete: str) -> list[str]:
    """Trackers by their id."""
    from dynslam_bench.trackers import TRACKERS

    return _beginning(incomplete, (found.spec.id for found in TRACKERS.all()))


def sequences(incomplete: str) -> list[str]:
    """Ids of the catalogue and of rendered sequences."""
    from dynslam_bench.sequences.listing import summaries

    return _beginning(incomplete, (each.id for each in summaries()))


def settings(ctx: typer.Context, incomplete: str) -> list[str]:
    """``NAME=`` of every setting of the tracker that the line names, and ``NAME=CHOICE`` where it has choices."""
    from dynslam_bench.core.settings import flatten, parameters

    try:
        chosen = _tracker(ctx).settings
    except DynslamError:
        return []
    names = [f"{name}=" for name in flatten(chosen())]
    choices = [f"{each.name}={choice}" for each in parameters(chosen) for choice in each.choices or ()]
    return _beginning(incomplete, names + (choices if "=" in incomplete else []))


def presets(ctx: typer.Context, incomplete: str) -> list[str]:
    """Presets of the tracker that the line names."""
    try:
        return _beginning(incomplete, _tracker(ctx).presets)
    except DynslamError:
        return []


def suites(incomplete: str) -> list[str]:
    """Names of the suites that come along, and TOML files."""
    from dynslam_bench.suites import suite_names

    return _beginning(incomplete, [*suite_names(), *map(str, Path().glob("*.toml"))])


def export_formats(incomplete: str) -> list[str]:
    """Formats that `export` writes."""
    from dynslam_bench.runs.exchange.export import FORMATS

    return _beginning(incomplete, FORMATS)


def protocols(incomplete: str) -> list[str]:
    """Protocols by their id."""
    from dynslam_bench.evaluation.protocol import PROTOCOLS

    return _beginning(incomplete, PROTOCOLS)


def statuses(incomplete: str) -> list[str]:
    """How runs end."""
    from typing import get_args

    from dynslam_bench.runs.storage.record import Status

    return _beginning(incomplete, get_args(Status))


def _tracker(ctx: typer.Context) -> TrackerSpec:
    """The tracker that the line names: its first word; while a line is completed it may not have been read yet."""
    from dynslam_bench.trackers import TRACKERS

    return TRACKERS.get(str(ctx.params.get("tracker") or next(iter(ctx.args), "")))


def _beginning(incomplete: str, names: Iterable[str]) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]
