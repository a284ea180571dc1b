"""Options that several verbs share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Optional

import typer

from .output import for_scripts

DataRoot = Annotated[
    Optional[Path],  # noqa: UP045 - typer reads it at run time, on Python 3.10 too
    typer.Option("--data-root", help="Folder of the sequences; default DYNSLAM_BENCH_DATA, else the user's cache."),
]
Results = Annotated[Path, typer.Option("--results", help="Results folder.")]
AsJson = Annotated[bool, typer.Option("--json", callback=for_scripts, help="Write JSON for scripts, and nothing else.")]
Camera = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option("--camera", help="tum-fr1, tum-fr2, tum-fr3, bonn or a camera.toml."),
]
Frames = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option("--frames", metavar="A:B", help="Part of the sequence: from frame A up to, not including, B."),
]
Stride = Annotated[int, typer.Option("--stride", min=1, help="Take every so many frames.")]
Device = Annotated[str, typer.Option("--device", help="auto, cpu or cuda:N.")]
Threads = Annotated[int, typer.Option("--threads", min=1, help="Threads of a run.")]
Jobs = Annotated[int, typer.Option("--jobs", "-j", min=1, help="Runs at a time.")]
Seeds = Annotated[
    Optional[list[int]],  # noqa: UP045
    typer.Option("--seed", help="Seeds, several allowed: --seed 0 1 2."),
]
Offsets = Annotated[
    Optional[list[int]],  # noqa: UP045
    typer.Option(
        "--offset", min=0, help="Start so many frames later, a repeat on the same frames; several: --offset 0 1 2."
    ),
]
Assignments = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option("--set", metavar="NAME=VALUE", help="Set a setting, e.g. epipolar.threshold_px=1.5; repeatable."),
]
SettingsFile = Annotated[
    Optional[Path],  # noqa: UP045
    typer.Option("--settings", help="TOML file of settings, e.g. a preset that `tune best` wrote."),
]
ProtocolId = Annotated[str, typer.Option("--protocol", help="How to evaluate; see `protocols list`.")]
Retry = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option("--retry", help="Run again what ended so: failed, or a status."),
]
Preset = Annotated[Optional[str], typer.Option("--preset", help="A preset of the tracker.")]  # noqa: UP045
Realtime = Annotated[bool, typer.Option("--realtime", help="Drop frames while the tracker is busy.")]
Drop = Annotated[float, typer.Option("--drop", min=0.0, max=0.99, help="Drop this share of the frames at random.")]
Degrade = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option(
        "--degrade",
        metavar="KIND=STRENGTH",
        help="Spoil the images: lighting, glare, shadow, blur, noise; repeatable.",
    ),
]
Cache = Annotated[bool, typer.Option("--cache", help="Take features and masks from the stage cache.")]
Video = Annotated[bool, typer.Option("--video", help="Write video.webm beside the run.")]
Sheet = Annotated[
    bool, typer.Option("--sheet", help="Write sheet.png beside the run: input, frames, keyframes, map, track.")
]
Label = Annotated[str, typer.Option("--label", help="Name in tables, in place of the tracker's.")]
Trackers = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option("--tracker", help="Only this tracker, or another one; repeatable."),
]
Scheduler = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option(
        "--scheduler", metavar="ADDRESS", help="A Dask scheduler, e.g. tcp://host:8786; its workers make the runs."
    ),
]
TimeLimit = Annotated[
    Optional[float],  # noqa: UP045
    typer.Option("--time-limit", help="Seconds that a run may take; default is no limit on the whole run."),
]
MemoryLimit = Annotated[
    Optional[float],  # noqa: UP045
    typer.Option(
        "--memory-limit",
        min=0,
        help="MB that a run may take; default is 80 % of the machine's memory, shared by --jobs; 0 is no limit.",
    ),
]


def gather_settings(assignments: list[str] | None, file: Path | None, preset: dict[str, Any]) -> dict[str, Any]:
    """Overrides by dotted name: the preset's, then the file's, then the assignments'.

    Raises:
        SettingsError: The file cannot be read, or an assignment is none.
    """
    from dynslam_bench.core.settings import parse_assignments

    merged = dict(preset)
    if file is not None:
        merged |= read_settings(file)
    return merged | parse_assignments(assignments or ())


def read_settings(file: Path) -> dict[str, Any]:
    """Overrides by dotted name from a TOML file; a table ``[settings]`` holds them if there is one.

    Raises:
        SettingsError: The file cannot be read, or is no TOML.
    """
    from dynslam_bench.core.errors import SettingsError
    from dynslam_bench.core.toml import read_toml

    document = read_toml(file.expanduser(), kind=SettingsError)
    values = document.get("settings", document)
    if not isinstance(values, dict):
        raise SettingsError(f"'settings' in {file} is {values!r}, not a table")
    return dict(_flatten(values))


def _flatten(values: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for key, value in values.items():
        found += _flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else [(f"{prefix}{key}", value)]
    return found
