"""The specification of a run: tracker, sequence, frames, settings, device and limits."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, Field, field_validator

from dynslam_bench.core import SequenceError
from dynslam_bench.core.records import Record
from dynslam_bench.sequences.catalogue import entry_of, parse_frames

MAP_SETTING = "backend.map.file"
"""The setting that names the map to begin in."""


class Limits(Record):
    """Limits of a run's time and memory; no part of its identity.

    Attributes:
        time_s: Wall-clock time of the whole run; None for no limit.
        start_s: Time until frame 0 is tracked, and until frame 1 is: loading networks, compiling
            kernels.
        frame_s: Time for any later frame, and for the final optimisation.
        memory_mb: Memory of the run's process and its children, shared pages counted once; None for
            the default, a share of the machine's memory (see `supervisor.memory_limit`), 0 for no
            limit.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    time_s: float | None = Field(default=None, gt=0)
    start_s: float = Field(default=600.0, gt=0)
    frame_s: float = Field(default=120.0, gt=0)
    memory_mb: float | None = Field(default=None, ge=0)


class RunSpec(Record):
    """One run: a tracker with settings, on a sequence, with a seed.

    Attributes:
        tracker: Id, ``id:value``, ``module:Attr`` or ``file.py:Attr``.
        sequence: Id or path of a folder in TUM layout.
        settings: Overrides of the tracker's settings, dotted name to value.
        frames: Part of the sequence, ``(start, stop)`` or ``"start:stop"``; None for all.
        offset: So many leading frames of that part are left out: a repeat on the same frames from a
            later start.
        stride: Take every so many frames.
        seed: Seed of everything random.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        threads: Threads of the run.
        cache: Take features and network masks from the stage cache where they are stored. Part of
            the run's identity: its stage times are those of the time when the entries were made.
        realtime: Drop the frames that arrive while the tracker is busy.
        drop_share: Drop this share of the frames at random.
        degrade: Strengths of `DegradeFrames`, e.g. ``{"blur": 0.5}``.
        data_root: Folder of the recorded sequences; None for the default one.
        camera: Camera of a folder that does not say its own.
        snapshots: Whether to keep some frames as the tracker saw them: ``frame_*.webp`` and
            ``snapshots.npz``.
        video: Whether to write ``video.webm``.
        sheet: Whether to write ``sheet.png``: input, frames, keyframes, map and track on one page.
        rrd: Whether to write ``recording.rrd`` for rerun's viewer.
        save_map: Whether to write ``map.npz``, from which a later run may start (setting
            ``backend.map.file``).
        label: Name in tables, in place of the tracker's; no part of the run's identity.
        study: Study that makes it; empty for any other run; no part of the run's identity.
        limits: What it may take.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    tracker: str
    sequence: str
    settings: dict[str, Any] = Field(default_factory=dict)
    frames: tuple[int, int | None] | None = None
    offset: int = Field(default=0, ge=0)
    stride: int = Field(default=1, ge=1)
    seed: int = Field(default=0, ge=0, lt=2**63)
    device: str = "auto"
    threads: int = Field(default=1, ge=1, le=1024)
    cache: bool = False
    realtime: bool = False
    drop_share: float = Field(default=0.0, ge=0, lt=1)
    degrade: dict[str, float] = Field(default_factory=dict)
    data_root: str | None = None
    camera: str | None = None
    snapshots: bool = False
    video: bool = False
    sheet: bool = False
    rrd: bool = False
    save_map: bool = False
    label: str = ""
    study: str = ""
    limits: Limits = Field(default_factory=Limits)

    @field_validator("frames", mode="before")
    @classmethod
    def _read_frames(cls, value: object) -> object:
        """``"A:B"`` is read as a pair; the whole sequence is None, however it is written."""
        if isinstance(value, str):
            value = parse_frames(value)
        return None if value in ((0, None), [0, None]) else value

    @property
    def frames_seen(self) -> tuple[int, int | None] | None:
        """The part that the tracker sees: `frames` without the `offset` leading ones; None for all.

        Raises:
            SequenceError: The offset leaves no frame of the part.
        """
        start, stop = self.frames or (0, None)
        if stop is not None and start + self.offset >= stop:
            raise SequenceError(
                f"offset {self.offset} leaves none of the {stop - start} frames {start}:{stop}"
            )
        return (start + self.offset, stop) if self.offset else self.frames

    def absolute(self) -> RunSpec:
        """This run, named independently of the working folder."""
        settings = self.settings
        # with its links followed: ``latest`` is another run's folder soon
        if settings.get(MAP_SETTING):
            map_file = Path(settings[MAP_SETTING]).expanduser().resolve()
            settings = settings | {MAP_SETTING: str(map_file)}

        data_root = self.data_root
        if data_root is not None:
            data_root = str(Path(data_root).expanduser().absolute())

        camera = self.camera
        if camera is not None and Path(camera).expanduser().is_file():
            camera = str(Path(camera).expanduser().absolute())

        return self.model_copy(
            update={
                "tracker": absolute_target(self.tracker),
                "sequence": _absolute_folder(self.sequence),
                "data_root": data_root,
                "camera": camera,
                "settings": settings,
            }
        )


def absolute_target(tracker: str) -> str:
    """``file.py:Attr`` and ``id:FILE`` with the file's absolute path; other names as they are."""
    head, _, tail = tracker.rpartition(":")
    if head.endswith(".py"):
        return f"{Path(head).expanduser().resolve()}:{tail}"
    prefix, _, value = tracker.partition(":")
    file = Path(value).expanduser()  # of no value the working folder
    return f"{prefix}:{file.resolve()}" if file.is_file() else tracker


def _absolute_folder(sequence: str) -> str:
    """The absolute path of a sequence that is named by its folder; an id as it is."""
    if sequence.startswith((".", "~", os.sep)):
        return str(Path(sequence).expanduser().absolute())
    is_id = sequence.startswith("synthetic/") or entry_of(sequence) is not None
    if is_id or not Path(sequence).is_dir():
        return sequence
    return str(Path(sequence).absolute())


def place_of(sequence: str) -> str:
    """Absolute folder of a sequence that is named by its path; empty for an id."""
    name = _absolute_folder(sequence)
    return name if Path(name).is_absolute() else ""
