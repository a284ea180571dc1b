"""Which cells of the board are empty, the commands that fill them, and the one that makes a run again."""

from __future__ import annotations

import shlex
from collections.abc import Iterable

from dynslam_bench.core.toml import setting_text
from dynslam_bench.reports.model.board import Board
from dynslam_bench.reports.model.row import RunRow

_MOST = 8


def missing_note(board: Board) -> str:
    """One paragraph: what the ranking stands on, and what is missing for more; empty where nothing is."""
    lacking = {key: board.lacking(key) for key in _candidates(board) if board.lacking(key)}
    if not lacking or not board.sequences:
        return ""
    parts = []
    if board.on == "common" and board.ranked:
        total = len(board.sequences)
        common = len(board.common)
        if common < total:
            parts.append(f"The ranking stands on the {common} of {total} sequences that all ranked trackers have.")
    if board.incomplete:
        left = ", ".join(board.labels[key] for key in board.incomplete)
        why = "lack sequences" if board.on == "all" else "lack too many of the others' sequences"
        parts.append(f"Not ranked, since they {why}: {left}.")
    cells = "; ".join(f"{board.labels[key]} on {_list(names)}" for key, names in list(lacking.items())[:_MOST])
    more = f"; and {len(lacking) - _MOST} more trackers" if len(lacking) > _MOST else ""
    parts.append(f"Missing cells: {cells}{more}. The commands that fill them stand at the end of this section.")
    return " ".join(parts)


def missing_commands(board: Board) -> list[str]:
    """Commands that make the runs of the missing cells of all that can be run here."""
    commands: list[str] = []
    plainest: dict[str, RunRow] = {}  # of every sequence a run without offset or noise, if there is one
    for row in sorted(board.rows, key=lambda row: (row.noise is not None, row.offset)):
        plainest.setdefault(board.sequence(row), row)
    for key in _candidates(board):
        row = board.first(key)
        lacking = board.lacking(key)
        if not lacking or row.imported:
            continue
        wanted: dict[tuple[str, ...], list[str]] = {}
        for name in lacking:
            other = plainest[name]
            wanted.setdefault(tuple(other.part_options), []).append(other.place or other.sequence)
        seeds = sorted({run.seed for run in board.runs(key)})
        offsets = sorted({run.offset for run in board.runs(key)})
        repeats = ["--seed", *map(str, seeds)] if seeds != [0] else []
        repeats += ["--offset", *map(str, offsets)] if offsets != [0] else []
        for part, names in wanted.items():
            words = ["dynslam-bench", "run", row.given or row.tracker, *names, *part, *repeats, *_settings(row)]
            commands.append(shlex.join(words))
    return commands


def run_command(row: RunRow) -> str:
    """The command that makes one run again; empty for an imported trajectory."""
    if row.imported:
        return ""
    words = ["dynslam-bench", "run", row.given or row.tracker, row.place or row.sequence, *row.part_options]
    words += ["--seed", str(row.seed)] if row.seed else []
    words += ["--offset", str(row.offset)] if row.offset else []
    return shlex.join([*words, *_settings(row)])


def _candidates(board: Board) -> list[str]:
    """The trackers that could be ranked."""
    firsts = {key: board.first(key) for key in board.trackers}
    return [key for key, row in firsts.items() if row.ranked and row.is_current and row.provenance != "control"]


def _settings(row: RunRow) -> list[str]:
    words: list[str] = []
    for name, value in row.variant.items():
        if name == "threads":
            words += ["--threads", str(value)] if value != 1 else []
        elif name == "device":
            words += ["--device", str(value)] if value not in ("cpu", "") else []
        elif name == "map":
            words += ["--map", row.map_file]
        elif name == "realtime":
            words.append("--realtime")
        elif name == "drop_share":
            words += ["--drop", str(value)]
        elif name.startswith("degrade."):
            words += ["--degrade", f"{name.removeprefix('degrade.')}={value}"]
        else:
            words += ["--set", f"{name}={setting_text(value)}"]
    return words


def _list(names: Iterable[str]) -> str:
    listed = list(names)
    return ", ".join(listed[:4]) + (f" and {len(listed) - 4} more" if len(listed) > 4 else "")
