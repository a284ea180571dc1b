"""The renderer of dynamic RGB-D sequences with exact poses, depth, masks and flow.

Importing this package loads neither numba nor OpenCV; opening a sequence does.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from dynslam_bench.sequences.synthetic.ids import (
    REPLICA_IDS,
    SYNTHETIC_IDS,
    SyntheticId,
    parse_synthetic_id,
)
from dynslam_bench.sequences.synthetic.settings import (
    CAMERA,
    HELD_OUT_SCENES,
    TUNE_SCENES,
    RenderSettings,
)

if TYPE_CHECKING:
    from dynslam_bench.sequences.synthetic.sequence import SyntheticSequence

__all__ = [
    "CAMERA",
    "HELD_OUT_SCENES",
    "REPLICA_IDS",
    "SYNTHETIC_IDS",
    "TUNE_SCENES",
    "RenderSettings",
    "SyntheticId",
    "open_synthetic",
    "parse_synthetic_id",
    "render_synthetic",
]


def open_synthetic(
    id: str,
    cache_root: Path | None,
    *,
    settings: RenderSettings | None = None,
    threads: int | None = None,
) -> SyntheticSequence:
    """Open a rendered sequence; frames are rendered when first read and cached under ``cache_root/synthetic``.

    Args:
        id: For example ``synthetic/walking_xyz?scene=101&frames=150``.
        cache_root: Where rendered frames are kept; None keeps nothing and renders at every read.
        settings: What differs from the default rendering (noise, controls, lighting).
        threads: Threads a frame; None for the cores there are. The frames do not depend on it.

    Raises:
        SequenceError: Unknown id, or a scene or length out of range.
    """
    from dynslam_bench.sequences.synthetic.sequence import SyntheticSequence

    return SyntheticSequence(
        parse_synthetic_id(id), cache_root, settings or RenderSettings(), threads
    )


def render_synthetic(
    id: str,
    cache_root: Path,
    *,
    settings: RenderSettings | None = None,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Render all frames of a sequence that are not cached yet; returns the folder, in TUM layout.

    Args:
        id: Id of the sequence, e.g. ``synthetic/walking_xyz?scene=101&frames=150``.
        cache_root: Folder under which the frames are cached, as ``cache_root/synthetic``.
        settings: What differs from the default rendering (noise, controls, lighting).
        threads: Frames rendered at a time; None for the cores there are, at most four.
        progress: Called with (frames done, frames in all).

    Raises:
        SequenceError: Unknown id.
        DynslamError: The cache cannot be written; what was rendered stays and is not rendered
            again.
    """
    sequence = open_synthetic(id, cache_root, settings=settings, threads=threads)
    sequence.render(progress)
    assert sequence.store is not None
    return sequence.store.folder
