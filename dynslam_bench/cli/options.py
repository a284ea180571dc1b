"""Options that several verbs share, their shell completion, and the classes of commands and groups."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any, Optional, get_args

import typer
from typer.core import TyperCommand, TyperGroup, TyperOption

from dynslam_bench.cli.output import set_json_mode
from dynslam_bench.core import DynslamError, read_settings

if TYPE_CHECKING:
    from dynslam_bench.contracts import TrackerSpec

# Headings below which the program's help lists its verbs.
START = "Begin here"
MEASURE = "Run and measure"
REPORT = "Report and tune"
CARE = "Extend and care"

# Headings below which the help of a verb lists its options.
FRAMES = "Which frames, how often"
SETTINGS = "The tracker's settings"
MACHINE = "The machine, and how much of it"
OUTPUT = "What is kept and shown"


class DefaultGroup(TyperGroup):
    """A group with the default verb ``make``: ``report results`` is ``report make results``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the default verb where none is named."""
        if not args or (args[0] not in self.commands and args[0] not in ("-h", "--help")):
            args = ["make", *args]
        return super().parse_args(ctx, args)


class ShortHelp(TyperCommand):
    """A command whose ``--help`` leaves out rarely used options; ``--help-all`` shows them."""

    RARE = frozenset(
        "stride threads realtime drop degrade cache video rrd save_map start_map localisation_only label "
        "time_limit memory_limit retry scheduler".split()
    )

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help."""
        for parameter in self.params:
            if isinstance(parameter, TyperOption):
                parameter.hidden = parameter.name in self.RARE and not ctx.meta.get("help-all")
        super().format_help(ctx, formatter)


def _help_all(ctx: typer.Context, on: bool) -> None:
    """Write the whole help and exit: the callback of ``--help-all``."""
    if on:
        ctx.meta["help-all"] = True
        typer.echo(ctx.get_help())
        raise typer.Exit


def names_of(place: str) -> Callable[[], list[str]]:
    """Shell completion by the names that an object holds, or a function of the package returns, loaded only then."""

    def complete() -> list[str]:
        names = resolve_name(f"dynslam_bench.{place}")
        return list(names() if callable(names) else names)

    return complete


complete_sequences = names_of("sequences.catalogue:sequence_ids")


def complete_trackers() -> list[str]:
    """Trackers by their id."""
    from dynslam_bench.trackers import TRACKERS

    return [tracker.spec.id for tracker in TRACKERS.all()]


def complete_settings(ctx: typer.Context, incomplete: str) -> Iterable[str]:
    """``NAME=`` of every setting of the tracker on the command line, and ``NAME=CHOICE`` where it has choices."""
    from dynslam_bench.core.settings import flatten, parameters

    spec = _tracker(ctx)
    if spec is None:
        return []
    if "=" not in incomplete:
        return [f"{name}=" for name in flatten(spec.settings())]
    assignments = []
    for parameter in parameters(spec.settings):
        assignments += [f"{parameter.name}={choice}" for choice in parameter.choices or ()]
    return assignments


def complete_presets(ctx: typer.Context) -> Iterable[str]:
    """Presets of the tracker on the command line."""
    spec = _tracker(ctx)
    return [] if spec is None else list(spec.presets)


def complete_statuses() -> tuple[str, ...]:
    """The statuses of runs."""
    from dynslam_bench.runs.record import Status

    return get_args(Status)


def _tracker(ctx: typer.Context) -> TrackerSpec | None:
    """The tracker on the command line, its first word; None if it is unknown."""
    from dynslam_bench.trackers import TRACKERS

    # what follows is not parsed yet while an option is completed
    name = ctx.params.get("tracker") or next(iter(ctx.args), "")
    try:
        return TRACKERS.get(str(name))
    except DynslamError:
        return None


# Options that several verbs take, each with its help.
HelpAll = Annotated[
    bool,
    typer.Option(
        "--help-all", is_eager=True, callback=_help_all, help="Show all options and exit."
    ),
]
DataRoot = Annotated[
    Optional[Path],
    typer.Option(
        "--data-root",
        help="Folder of the sequences; default DYNSLAM_BENCH_DATA, else the user's cache.",
        rich_help_panel=FRAMES,
    ),
]
Results = Annotated[Path, typer.Option("--results", help="Results folder.", rich_help_panel=OUTPUT)]
AsJson = Annotated[
    bool,
    typer.Option(
        "--json",
        callback=set_json_mode,
        help="Write JSON for scripts, and nothing else.",
        rich_help_panel=OUTPUT,
    ),
]
Camera = Annotated[
    Optional[str],
    typer.Option(
        "--camera", help="tum-fr1, tum-fr2, tum-fr3, bonn or a camera.toml.", rich_help_panel=FRAMES
    ),
]
Yes = Annotated[
    bool,
    typer.Option(
        "--yes",
        "-y",
        help="Download the network for masks without asking.",
        rich_help_panel=MACHINE,
    ),
]
Frames = Annotated[
    Optional[str],
    typer.Option(
        "--frames",
        metavar="A:B",
        help="Part of the sequence: from frame A up to, not including, B.",
        rich_help_panel=FRAMES,
    ),
]
Stride = Annotated[
    int, typer.Option("--stride", min=1, help="Take every so many frames.", rich_help_panel=FRAMES)
]
Device = Annotated[
    str, typer.Option("--device", help="auto, cpu or cuda:N.", rich_help_panel=MACHINE)
]
Threads = Annotated[
    int, typer.Option("--threads", min=1, help="Threads of a run.", rich_help_panel=MACHINE)
]
Snapshots = Annotated[
    bool,
    typer.Option(
        "--snapshots",
        help="Keep pictures, features and masks of some frames, for reports.",
        rich_help_panel=OUTPUT,
    ),
]
Jobs = Annotated[
    int, typer.Option("--jobs", "-j", min=1, help="Runs at a time.", rich_help_panel=MACHINE)
]
Seeds = Annotated[
    Optional[list[int]],
    typer.Option(
        "--seed", min=0, help="Seeds, several allowed: --seed 0 1 2.", rich_help_panel=FRAMES
    ),
]
Offsets = Annotated[
    Optional[list[int]],
    typer.Option(
        "--offset",
        min=0,
        help="Start so many frames later, a repeat on the same frames; several: --offset 0 1 2.",
        rich_help_panel=FRAMES,
    ),
]
Assignments = Annotated[
    Optional[list[str]],
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Set a setting, e.g. features.n_features=800; repeatable.",
        rich_help_panel=SETTINGS,
        autocompletion=complete_settings,
    ),
]
SettingsFile = Annotated[
    Optional[Path],
    typer.Option(
        "--settings",
        help="TOML file of settings, e.g. a preset that `tune best` wrote.",
        rich_help_panel=SETTINGS,
    ),
]
Timestamps = Annotated[
    Optional[Path],
    typer.Option(
        "--timestamps",
        metavar="FILE",
        help="Stamps where the format has none (KITTI, COLMAP): a times.txt, or rgb.txt.",
    ),
]
ProtocolId = Annotated[
    str,
    typer.Option(
        "--protocol",
        help="How to evaluate; see `protocols list`.",
        rich_help_panel=OUTPUT,
        autocompletion=names_of("evaluation.protocol:PROTOCOLS"),
    ),
]
Retry = Annotated[
    Optional[list[str]],
    typer.Option(
        "--retry",
        help="Run again what ended so: failed, or a status.",
        rich_help_panel=OUTPUT,
        autocompletion=complete_statuses,
    ),
]
TimeLimit = Annotated[
    Optional[float],
    typer.Option(
        "--time-limit",
        help="Seconds that a run may take; default is no limit on the whole run.",
        rich_help_panel=MACHINE,
    ),
]
MemoryLimit = Annotated[
    Optional[float],
    typer.Option(
        "--memory-limit",
        min=0,
        help="MB that a run may take; default is 80 % of the machine's memory, shared by --jobs; 0 is no limit.",
        rich_help_panel=MACHINE,
    ),
]


def gather_settings(set_options: list[str] | None, file: Path | None = None) -> dict[str, Any]:
    """Overrides by dotted name, of a file and of ``--set`` options; an option replaces the file's value.

    Raises:
        SettingsError: The file cannot be read, or an option is not of the form NAME=VALUE.
    """
    from dynslam_bench.core.settings import parse_assignments

    overrides = {} if file is None else read_settings(file)
    return overrides | parse_assignments(set_options or ())
