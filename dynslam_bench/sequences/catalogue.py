"""Every sequence by its id: the public data sets, the rendered ones, plug-ins, and folders of the user's own."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, cast

from dynslam_bench.contracts.sequence import Sequence
from dynslam_bench.core.code_files import leads_back
from dynslam_bench.core.digests import is_settled
from dynslam_bench.core.errors import SequenceError, did_you_mean
from dynslam_bench.core.folders import find_data_root, is_writable, user_cache
from dynslam_bench.core.plugins import load_object
from dynslam_bench.geometry.camera import Camera

from .published.cameras import MARKER_TO_CAMERA, chosen_camera, find_camera
from .published.datasets import DATASETS
from .published.entries import CatalogueEntry, by_folder, catalogue, entry_of, public_datasets
from .settings import PreprocessingSettings
from .synthetic import open_synthetic
from .view import SequenceView

__all__ = [
    "CatalogueEntry",
    "catalogue",
    "entry_of",
    "open_folder",
    "open_public",
    "open_rendered",
    "open_sequence",
    "parse_frames",
    "sequence_ids",
]


_OPENED: dict[str, tuple[list[tuple[str, int, int, int, int]], Sequence]] = {}
"""Folders that were opened, with the state of their files then: an unchanged one need not be read again."""
_MOST_OPENED = 64


def sequence_ids() -> list[str]:
    """Ids of all listed sequences: the public ones, the rendered ones, and those of plug-ins."""
    return [name for found in DATASETS.all() for name in found.spec.sequences]


def open_sequence(
    name: str | Path,
    *,
    data_root: str | Path | None = None,
    camera: str | Path | Camera | None = None,
    frames: tuple[int, int | None] | str | None = None,
    stride: int = 1,
    preprocessing: PreprocessingSettings | None = None,
) -> Sequence:
    """Open a sequence.

    Args:
        name: An id (``tum/fr3/walking_xyz``, ``bonn/crowd``, ``synthetic/walking_xyz?scene=0&frames=150``), a published
            folder name (``rgbd_dataset_freiburg3_walking_xyz``) or the path of a folder of a layout that is read.
        data_root: Folder of the sequences; default ``DYNSLAM_BENCH_DATA``, else the user's cache folder.
        camera: In place of what the catalogue or the folder says: ``tum-fr1``, ``tum-fr2``, ``tum-fr3``, ``bonn`` or a
            ``camera.toml``.
        frames: Part of the sequence, ``(first, one past the last or None)`` or ``"A:B"``.
        stride: Take every `stride`-th frame of that part.
        preprocessing: What to do with the frames; nothing by default.

    Returns:
        The sequence; nothing but its first frame was decoded.

    Raises:
        SequenceError: Unknown id (with a did-you-mean), not on this machine (with URL, size, path and the command that
            fetches it), damaged, or no frame in the part asked for.
    """
    settings = preprocessing or PreprocessingSettings()
    root = find_data_root(data_root)
    sequence = _open_whole(str(name), root, camera, settings)
    if settings.changes_images:
        from .preprocessing import Preprocessed

        sequence = cast("Sequence", Preprocessed(sequence, settings))
    return _part(sequence, frames, stride)


def open_public(sequence_id: str, *, data_root: Path, **how: Any) -> Sequence:
    """Open a sequence of the catalogue.

    Args:
        sequence_id: Its id.
        data_root: Folder of the sequences.
        **how: See `open_folder`.

    Raises:
        SequenceError: Unknown id, or it is not below the data root.
    """
    entry = entry_of(sequence_id)
    if entry is None:
        raise SequenceError(f"unknown sequence '{sequence_id}'", did_you_mean(sequence_id, sequence_ids()))
    folder = entry.find(data_root)
    if folder is None:
        raise SequenceError(
            f"sequence '{entry.id}' ({entry.size_text()}, {entry.url}) is not at {entry.folders(data_root)[0]}",
            entry.how_to_get(),
        )
    return open_folder(folder, entry=entry, **how)


def open_rendered(sequence_id: str, *, data_root: Path) -> Sequence:
    """Open a rendered sequence; its frames are kept below the data root, or in the user's cache if that is read-only.

    Args:
        sequence_id: For example ``synthetic/walking_xyz?scene=0&frames=150``.
        data_root: Folder of the sequences.

    Raises:
        SequenceError: Unknown id.
    """
    return open_synthetic(sequence_id, data_root if is_writable(data_root) else user_cache() / "data")


def open_folder(
    folder: Path,
    *,
    entry: CatalogueEntry | None = None,
    camera: str | Path | Camera | None = None,
    settings: PreprocessingSettings | None = None,
) -> Sequence:
    """Open a folder of one of the layouts that are read (`LAYOUTS`).

    Args:
        folder: The folder.
        entry: What the catalogue says of it; looked up by the folder's name if not given.
        camera: In place of what the catalogue or the folder says.
        settings: Tolerance of the pairing, and whether images will be resized.

    Raises:
        SequenceError: It cannot be opened, or its camera is not known.
    """
    settings = settings or PreprocessingSettings()
    entry = entry or entry_of(folder.resolve().name)
    chosen = chosen_camera(folder, camera)
    wanted = repr((folder.absolute(), entry and entry.id, str(camera), chosen, settings))
    state = _state_of(folder)
    known, sequence = _OPENED.get(wanted, (None, None))
    if sequence is None or known != state:
        sequence = _open_folder(folder, entry, camera, chosen, settings)
        while len(_OPENED) >= _MOST_OPENED:
            _OPENED.pop(next(iter(list(_OPENED)), ""), None)  # another thread may do the same
        if is_settled(max((max(file[2:4]) for file in state), default=None)):
            _OPENED[wanted] = state, sequence
    return sequence


def _open_folder(
    folder: Path,
    entry: CatalogueEntry | None,
    camera: str | Path | Camera | None,
    chosen: tuple[Camera, float | None] | None,
    settings: PreprocessingSettings,
) -> Sequence:
    from .readers.layouts import find_layout, layout_of
    from .readers.recorded import Description, RecordedSequence

    layout = find_layout(folder) if entry is None else layout_of(entry.layout)
    stated = None if chosen is None else chosen[1]
    contents = layout.read(folder, stated or (None if entry is None else entry.fps))
    otherwise = None if entry is None else entry.camera
    intrinsics, fps = chosen or find_camera(folder, told=contents.camera, otherwise=otherwise)
    body = MARKER_TO_CAMERA.get(str(camera) if entry is None else entry.camera)
    if entry is None:
        description = Description(f"folder/{folder.resolve().name}", intrinsics, fps or contents.fps, R_body_cam=body)
    else:
        about = (entry.license, entry.citation, frozenset(entry.tags), entry.split)
        description = Description(entry.id, intrinsics, fps or entry.fps, *about, body)
    return RecordedSequence(
        folder,
        contents,
        description,
        max_time_difference_s=settings.max_time_difference_s,
        any_depth_size=settings.width is not None,
    )


def _state_of(folder: Path) -> list[tuple[str, int, int, int, int]]:
    """Name, size, times of modification and of change, and inode of every file below a folder; empty without one."""
    state: list[tuple[str, int, int, int, int]] = []
    waiting = [str(folder)]
    while waiting:
        try:
            with os.scandir(waiting.pop()) as entries:
                for entry in entries:
                    if entry.is_dir():
                        waiting += [] if leads_back(Path(entry.path)) else [entry.path]
                    else:
                        stat = entry.stat()
                        state.append((entry.path, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino))
        except OSError:  # it vanished meanwhile; opening it says what is wrong
            return []
    return state


def _open_whole(
    name: str, data_root: Path, camera: str | Path | Camera | None, settings: PreprocessingSettings
) -> Sequence:
    from .readers.layouts import is_bag

    path = Path(name).expanduser()
    entry = None if _is_path(name) else entry_of(name)
    if entry is not None:
        return open_public(entry.id, data_root=data_root, camera=camera, settings=settings)
    prefix = name.partition("/")[0]
    datasets = {found.spec.id: found.spec for found in DATASETS.all()}
    if not _is_path(name) and "/" in name and prefix in datasets and prefix not in public_datasets():
        if camera is not None:
            raise SequenceError(f"sequence '{name}' brings its own camera", "leave out --camera")
        return cast("Sequence", load_object(datasets[prefix].entry_point)(name, data_root=data_root))
    if is_bag(path):
        raise SequenceError(f"{path} is a bag", f"unpack it first: dynslam-bench sequences unpack {path} FOLDER")
    if path.is_dir():
        return open_folder(path, camera=camera, settings=settings)
    if _is_path(name):
        raise SequenceError(
            f"there is no sequence folder {path.absolute()}",
            "a path names a folder, see docs/sequences.md",
        )
    known = [*sequence_ids(), *by_folder()]
    raise SequenceError(f"unknown sequence '{name}', and there is no such folder", did_you_mean(name, known))


def _is_path(name: str) -> bool:
    return name.startswith((".", "/", "~", "\\"))


def _part(sequence: Sequence, frames: tuple[int, int | None] | str | None, stride: int) -> Sequence:
    start, stop = parse_frames(frames)
    if stride < 1:
        raise SequenceError(f"stride is {stride}, expected at least 1")
    if (start, stop, stride) == (0, None, 1):
        return sequence
    view = SequenceView(sequence, start, stop, stride)
    if not len(view):
        end = "" if stop is None else stop
        raise SequenceError(f"frames {start}:{end} hold none of the {len(sequence)} frames of '{sequence.id}'")
    return cast("Sequence", view)


def parse_frames(frames: tuple[int, int | None] | str | None) -> tuple[int, int | None]:
    """First frame and one past the last (None: to the end) of ``"A:B"``, ``"A:"``, ``":B"`` or a pair.

    Raises:
        SequenceError: It is no such range.
    """
    if frames is None:
        return 0, None
    first: int | str
    last: int | str | None
    if isinstance(frames, str):
        first, separator, last = frames.partition(":")
        if not separator:
            raise SequenceError(f"'{frames}' is no range of frames", "write it as A:B, A: or :B")
    else:
        first, last = frames
    try:
        start = int(first) if first != "" else 0
        stop = None if last is None or last == "" else int(last)
    except ValueError:
        raise SequenceError(f"'{frames}' is no range of frames", "write it as A:B, A: or :B") from None
    if start < 0 or (stop is not None and stop <= start):
        raise SequenceError(f"frames {start}:{'' if stop is None else stop} is no range of frames", "0 <= A < B")
    return start, stop
