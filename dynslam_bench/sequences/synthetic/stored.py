"""Rendered frames on disk: those that this code reads again, and those that other code has left."""

import re
from dataclasses import dataclass
from pathlib import Path

from dynslam_bench.core import SequenceError
from dynslam_bench.sequences.synthetic import open_synthetic

_FOLDER = re.compile(
    r"(?P<name>\w+)@(?P<scene>\d+)(?:-noise(?P<noise>\d+))?-(?P<rendered_by>[0-9a-f]{8})"
)
"""The name of a sequence's folder, see `SyntheticSequence`."""


@dataclass(frozen=True)
class Rendering:
    """The stored frames of one rendered sequence.

    Attributes:
        folder: Folder in which they lie.
        size: Size of all files together, bytes.
        is_current: Whether this code reads them, at the default rendering settings.
    """

    folder: Path
    size: int
    is_current: bool


def renderings(cache_root: Path) -> list[Rendering]:
    """The renderings below a folder of sequences, sorted by their names.

    Args:
        cache_root: Folder under which rendered frames are cached, as ``cache_root/synthetic``.
    """
    stored = []
    for folder in sorted((cache_root / "synthetic").glob("*@*")):
        if folder.is_dir():
            files = [path for path in folder.rglob("*") if path.is_file()]
            size = sum(path.stat().st_size for path in files)
            stored.append(Rendering(folder, size, _is_current(folder, cache_root)))
    return stored


def _is_current(folder: Path, cache_root: Path) -> bool:
    """Whether a folder is the one in which this code looks for the frames of its sequence."""
    match = _FOLDER.fullmatch(folder.name)
    if match is None:
        return False
    noise = "" if match["noise"] is None else f"&noise={match['noise']}"
    try:
        sequence = open_synthetic(
            f"synthetic/{match['name']}?scene={match['scene']}{noise}", cache_root
        )
    except SequenceError:  # there is no such sequence any more
        return False
    return sequence.store is not None and sequence.store.folder == folder
