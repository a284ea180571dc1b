"""Pictures of frames for the pages of runs: drawn when the report is made, from the sequence itself, once a frame."""

from __future__ import annotations

import base64
import time
from collections import Counter
from collections.abc import Sequence as PySequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.sequence import Sequence
from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.records import write_atomic
from dynslam_bench.reports.figures import significant
from dynslam_bench.reports.html.page import write_side
from dynslam_bench.reports.html.run_page import RunFrames
from dynslam_bench.reports.model.load import LoadedRun
from dynslam_bench.runs.artifacts import Snapshot, read_snapshots, spread
from dynslam_bench.runs.exchange.export import open_stored

FOLDER = "frames"
EVEN, WORST = 16, 4
"""Frames of a run that are shown evenly spread, and those with the largest frame-to-frame error."""
_WIDTH, _QUALITY = 480, 62
_MASK_WIDTH = 240


@dataclass
class PictureBook:
    """Draws the frames that runs show, as long as there is time for it; what is there already is not drawn again.

    Args:
        output: Folder of the report.
        seconds: Time that opening and drawing may take altogether.
    """

    output: Path
    seconds: float
    _spent: float = 0.0
    _opened: dict[tuple[Any, ...], Sequence | str] = field(default_factory=dict)

    def add(self, run: LoadedRun, frames: RunFrames, missing: Counter[str]) -> bool:
        """Draw the frames that a run shows and write what was seen on them as ``data/looks-<run id>.js``.

        Args:
            run: The run.
            frames: Its frames.
            missing: Why some frames have no picture, which is counted there.

        Returns:
            Whether there is anything to see.
        """
        if not len(frames):
            return False
        try:
            size, shots = read_snapshots(run.store.folder(run.row.run_id))
        except DynslamError as error:
            missing[str(error)] += 1
            return False
        began = time.perf_counter()
        by_index = {shot.index: shot for shot in shots}
        chosen = _chosen(frames, sorted(by_index))
        looks = [self._look(run, index, by_index.get(index), size, missing) for index in chosen]
        self._spent += time.perf_counter() - began
        known = [look for look in looks if look.get("image") or look.get("points")]
        if not known:
            return False
        errors = dict(zip(frames.columns["index"].tolist(), (1000 * frames.errors_m).tolist(), strict=True))
        for look in known:
            look["error_mm"] = significant(errors.get(look["index"]))
        write_side(self.output, f"looks-{run.row.run_id}", {"looks": known, "stored": bool(shots)})
        return True

    def _look(
        self, run: LoadedRun, index: int, shot: Snapshot | None, size: tuple[int, int], missing: Counter[str]
    ) -> dict[str, Any]:
        try:
            look: dict[str, Any] = {"index": index, "image": self._image(run, index)}
        except DynslamError as error:
            missing[str(error)] += 1
            look = {"index": index}
        return look if shot is None else look | _seen(shot, size)

    def _image(self, run: LoadedRun, index: int) -> str:
        """Relative path of the picture of a frame; drawn if it is not there yet.

        Raises:
            DynslamError: The sequence cannot be opened, is another one by now, or the time is over.
        """
        record = run.record
        number = (record.frames or (0, None))[0] + (index * record.stride) + record.offset
        path = self.output / FOLDER / (record.sequence.block or record.sequence.part) / f"{number}.webp"
        if not path.is_file():
            if self._spent >= self.seconds:
                raise DynslamError(f"not drawn within {self.seconds:.0f} s", "make the report again: it goes on there")
            began = time.perf_counter()
            image = self._sequence(run)[index].rgb
            self._spent += time.perf_counter() - began
            write_atomic(path, _coded(".webp", _shrunk(image[:, :, ::-1], _WIDTH), cv2.IMWRITE_WEBP_QUALITY, _QUALITY))
        return path.relative_to(self.output).as_posix()

    def _sequence(self, run: LoadedRun) -> Sequence:
        record = run.record
        key = (record.place or record.sequence.id, record.frames, record.offset, record.stride, record.sequence.content)
        if key not in self._opened:
            try:
                self._opened[key] = open_stored(run.record)
            except DynslamError as error:
                self._opened[key] = str(error)
        found = self._opened[key]
        if isinstance(found, str):
            raise DynslamError(found)
        return found


def _chosen(frames: RunFrames, stored: PySequence[int]) -> list[int]:
    """Frames to show: some spread over the run, and the worst; of those that the run has stored, if it has any."""
    indices = frames.columns["index"]
    order = np.argsort(-np.nan_to_num(frames.errors_m, nan=-1.0), kind="stable")
    bad = [int(indices[at]) for at in order if np.isfinite(frames.errors_m[at])]
    if not stored:
        return sorted({int(indices[at]) for at in spread(len(frames), EVEN)} | set(bad[:WORST]))
    even = {stored[at] for at in spread(len(stored), EVEN)}
    return sorted(even | set([index for index in bad if index in set(stored)][:WORST]))


def _seen(shot: Snapshot, size: tuple[int, int]) -> dict[str, Any]:
    """Features (two bytes each: x and y in 255ths of the image), which were kept, and the mask as a small image."""
    height, width = size
    places = np.clip(shot.points * np.array((255 / width, 255 / height), np.float32), 0, 255).round().astype(np.uint8)
    order = np.argsort(shot.kept, kind="stable")  # culled ones first
    seen = {"points": base64.b64encode(places[order].tobytes()).decode(), "culled": int((~shot.kept).sum())}
    seen |= {"width": width, "height": height}
    mask = shot.mask
    if mask is None:
        return seen | {"share": None}
    seen["share"] = significant(100 * np.count_nonzero(mask) / mask.size, 3)
    if not seen["share"]:
        return seen
    small = cv2.resize(mask.view(np.uint8), _shrunk_size(mask, _MASK_WIDTH), interpolation=cv2.INTER_NEAREST)
    coded = base64.b64encode(_coded(".png", np.asarray(small), cv2.IMWRITE_PNG_BILEVEL, 1)).decode()
    return seen | {"mask": f"data:image/png;base64,{coded}"}


def _shrunk_size(image: NDArray[Any], width: int) -> tuple[int, int]:
    return width, max(round(image.shape[0] * width / image.shape[1]), 1)


def _shrunk(image: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    size = _shrunk_size(image, width)
    return np.asarray(cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA), np.uint8)


def _coded(kind: str, image: NDArray[Any], *options: int) -> bytes:
    done, coded = cv2.imencode(kind, image, options)
    if not done:
        raise DynslamError(f"this OpenCV cannot write {kind} images")
    return bytes(coded)
