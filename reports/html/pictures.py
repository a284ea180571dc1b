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
from dynslam_bench.core.files import write_atomic
from dynslam_bench.reports.figures import significant
from dynslam_bench.reports.html.page import write_side
from dynslam_bench.reports.html.run_page import RunFrames
from dynslam_bench.reports.model.row import RunRow
from dynslam_bench.runs.artifacts import Snapshot, read_snapshots, spread
from dynslam_bench.runs.exchange.export import open_stored
from dynslam_bench.runs.record import RunRecord

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
    _opened: dict[tuple[Any, ...], Sequence | DynslamError] = field(default_factory=dict)

    def add(self, row: RunRow, record: RunRecord, frames: RunFrames, missing: Counter[str]) -> bool:
        """Draw the frames that a run shows and write what the tracker saw on them as ``data/looks-<run id>.js``.

        Args:
            row: The run.
            record: Its whole record.
            frames: Its frames.
            missing: Why some frames have no picture, which is counted there.

        Returns:
            Whether there is anything to see.
        """
        if not len(frames):
            return False
        try:
            size, snapshots = read_snapshots(row.folder)
        except DynslamError as error:
            missing[str(error)] += 1
            return False
        by_index = {snapshot.index: snapshot for snapshot in snapshots}
        errors_mm = dict(zip(frames.columns["index"].tolist(), (1000 * frames.errors_m).tolist(), strict=True))
        looks = []
        for index in _chosen(frames, sorted(by_index)):
            look: dict[str, Any] = {"index": index}
            try:
                look["image"] = self._image(record, index)
            except DynslamError as error:
                missing[str(error)] += 1
            if index in by_index:
                look |= _annotations(by_index[index], size)
            if look.get("image") or look.get("points"):
                looks.append(look | {"error_mm": significant(errors_mm.get(index))})
        if looks:
            write_side(self.output, f"looks-{row.run_id}", {"looks": looks, "stored": bool(snapshots)})
        return bool(looks)

    def _image(self, record: RunRecord, index: int) -> str:
        """Relative path of the picture of a frame; drawn if it is not there yet.

        Raises:
            DynslamError: The sequence cannot be opened, is another one by now, or the time is over.
        """
        number = (record.frames or (0, None))[0] + (index * record.stride) + record.offset
        path = self.output / FOLDER / (record.sequence.block or record.sequence.part) / f"{number}.webp"
        if not path.is_file():
            if self._spent >= self.seconds:
                raise DynslamError(f"not drawn within {self.seconds:.0f} s", "make the report again: it goes on there")
            began = time.perf_counter()
            image = self._sequence(record)[index].rgb
            size = _shrunk_size(image, _WIDTH)
            shrunk = cv2.resize(np.ascontiguousarray(image[:, :, ::-1]), size, interpolation=cv2.INTER_AREA)
            write_atomic(path, _encoded(".webp", np.asarray(shrunk), cv2.IMWRITE_WEBP_QUALITY, _QUALITY))
            self._spent += time.perf_counter() - began
        return path.relative_to(self.output).as_posix()

    def _sequence(self, record: RunRecord) -> Sequence:
        key = (record.place or record.sequence.id, record.frames, record.offset, record.stride, record.sequence.content)
        if key not in self._opened:
            try:
                self._opened[key] = open_stored(record)
            except DynslamError as error:
                self._opened[key] = error
        opened = self._opened[key]
        if isinstance(opened, DynslamError):
            raise opened
        return opened


def _chosen(frames: RunFrames, stored: PySequence[int]) -> list[int]:
    """Frames to show: some spread over the run, and the worst; of those that the run has stored, if it has any."""
    indices = frames.columns["index"]
    order = np.argsort(-np.nan_to_num(frames.errors_m, nan=-1.0), kind="stable")
    bad = [int(indices[at]) for at in order if np.isfinite(frames.errors_m[at])]
    if not stored:
        return sorted({int(indices[at]) for at in spread(len(frames), EVEN)} | set(bad[:WORST]))
    even = {stored[at] for at in spread(len(stored), EVEN)}
    return sorted(even | set([index for index in bad if index in set(stored)][:WORST]))


def _annotations(snapshot: Snapshot, size: tuple[int, int]) -> dict[str, Any]:
    """Features (two bytes each: x and y in 255ths of the image), which were kept, and the mask as a small image."""
    height, width = size
    places = (
        np.clip(snapshot.points * np.array((255 / width, 255 / height), np.float32), 0, 255).round().astype(np.uint8)
    )
    order = np.argsort(snapshot.kept, kind="stable")  # culled ones first
    annotations = {"points": base64.b64encode(places[order].tobytes()).decode(), "culled": int((~snapshot.kept).sum())}
    annotations |= {"width": width, "height": height, "share": None}
    mask = snapshot.mask
    if mask is not None:
        annotations["share"] = significant(100 * np.count_nonzero(mask) / mask.size, 3)
    if mask is not None and annotations["share"]:
        small = cv2.resize(mask.view(np.uint8), _shrunk_size(mask, _MASK_WIDTH), interpolation=cv2.INTER_NEAREST)
        png = base64.b64encode(_encoded(".png", np.asarray(small), cv2.IMWRITE_PNG_BILEVEL, 1)).decode()
        annotations["mask"] = f"data:image/png;base64,{png}"
    return annotations


def _shrunk_size(image: NDArray[Any], width: int) -> tuple[int, int]:
    return width, max(round(image.shape[0] * width / image.shape[1]), 1)


def _encoded(kind: str, image: NDArray[Any], *options: int) -> bytes:
    done, data = cv2.imencode(kind, image, options)
    if not done:
        raise DynslamError(f"this OpenCV cannot write {kind} images")
    return bytes(data)
