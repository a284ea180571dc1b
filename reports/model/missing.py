"""Which cells of the board are empty, the commands that fill them, and the one that makes a run again."""

from __future__ import annotations

import shlex
from collections.abc import Iterable

from dynslam_bench.core.toml import setting_text
from dynslam_bench.reports.model.board import Board
from dynslam_bench.reports.model.row import RunRow, grouped

_MOST = 8


def missing_note(board: Board) -> str:
    """One paragraph: what the ranking stands on, and what is missing for more; empty where nothing is."""
    lacking = _lacking(board)
    if not lacking or not board.sequences:
        return ""
    parts = []
    common, total = len(board.common), len(board.sequences)
    if board.on == "common" and board.ranked and common < total:
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
    plainest = sorted(board.rows, key=lambda row: (row.sequence.noise is not None, row.offset))
    by_sequence = grouped(plainest, board.sequence)
    for key, lacking in _lacking(board).items():
        row = board.first(key)
        if row.imported:
            continue
        wanted: dict[tuple[str, ...], list[str]] = {}
        for other in (by_sequence[name][0] for name in lacking):
            wanted.setdefault(tuple(_part_options(other)), []).append(other.place or other.sequence.id)
        seeds = sorted({run.seed for run in board.runs(key)})
        offsets = sorted({run.offset for run in board.runs(key)})
        repeats = ["--seed", *map(str, seeds)] if seeds != [0] else []
        repeats += ["--offset", *map(str, offsets)] if offsets != [0] else []
        for part, names in wanted.items():
            commands.append(_command(row, [*names, *part, *repeats]))
    return commands


def run_command(row: RunRow) -> str:
    """The command that makes one run again; empty for an imported trajectory."""
    if row.imported:
        return ""
    words = [row.place or row.sequence.id, *_part_options(row)]
    words += ["--seed", str(row.seed)] if row.seed else []
    words += ["--offset", str(row.offset)] if row.offset else []
    return _command(row, words)


def _command(row: RunRow, words: Iterable[str]) -> str:
    return shlex.join(["dynslam-bench", "run", row.tracker.given or row.tracker.id, *words, *_settings(row)])


def _lacking(board: Board) -> dict[str, list[str]]:
    """The sequences on which each tracker that could be ranked was not run."""
    rankable = [key for key in board.trackers if board.is_rankable(key)]
    lacking = {key: [name for name in board.sequences if name not in board.cells[key]] for key in rankable}
    return {key: names for key, names in lacking.items() if names}


def _part_options(row: RunRow) -> list[str]:
    """Its part of the sequence as options of the command line."""
    options = []
    if row.frames is not None:
        start, stop = row.frames
        options += ["--frames", f"{start}:{'' if stop is None else stop}"]
    return options + (["--stride", str(row.stride)] if row.stride != 1 else [])


def _settings(row: RunRow) -> list[str]:
    words: list[str] = []
    for name, value in row.variant.items():
        if name == "threads":
            words += ["--threads", str(value)] if value != 1 else []
        elif name == "device":
            words += ["--device", str(value)] if value not in ("cpu", "") else []
        elif name == "map":
            words += ["--map", row.start_map.file if row.start_map else ""]
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
