"""What raises outside the tracker's own code is no outcome of it: nothing is stored, and the other runs go on."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from envs_toys import TARGET, write_folder

from dynslam_bench.core.errors import DynslamError, RunError
from dynslam_bench.runs import RunSpec, RunStore, run_many, run_one

FRAMES = 8
AT = 5


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:300])


def truncate_jpeg(path: Path) -> None:
    """A JPEG under a PNG's name, as decoders go by the content, cut off in the middle of the image."""
    whole = cv2.imencode(".jpg", cv2.imread(str(path)))[1].tobytes()
    path.write_bytes(whole[: len(whole) // 2])


def shrink(path: Path) -> None:
    cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[::2, ::2])


def deepen(path: Path) -> None:
    cv2.imwrite(str(path), cv2.imread(str(path)).astype(np.uint16) * 256)


FAULTS = {
    "truncated": (truncate, r"is truncated \(300 bytes\)"),
    "truncated jpeg": (truncate_jpeg, r"is truncated \(\d+ bytes\)"),
    "text": (lambda path: path.write_text("no image"), r"cannot be decoded \(8 bytes\)"),
    "another size": (shrink, r"is 80x60, but the camera"),
    "16 bits": (deepen, r"has 16 bits a channel, expected 8"),
}


@pytest.fixture
def damaged(tmp_path: Path) -> tuple[str, Path]:
    """A sequence, and its colour image of frame `AT`."""
    folder = write_folder(tmp_path / "toy", FRAMES)
    return str(folder), folder / (folder / "rgb.txt").read_text().split()[2 * AT + 1]


@pytest.mark.parametrize("fault", FAULTS)
def test_an_image_that_cannot_be_used_is_the_datas_fault(store: RunStore, damaged, fault: str) -> None:
    folder, image = damaged
    spoil, words = FAULTS[fault]
    sound = image.read_bytes()
    spoil(image)
    with pytest.raises(RunError, match=rf"frame {AT} of '.*' cannot be read: .*{image.name} .*({words})") as caught:
        run_one(RunSpec(tracker="never-move", sequence=folder), store)
    assert "\n" not in str(caught.value) and store.ids() == []
    image.write_bytes(sound)
    assert run_one(RunSpec(tracker="never-move", sequence=folder), store).status == "ok"


REMOVES = """
from pathlib import Path
from dynslam_bench.contracts import TrackerSpec, TrackResult
from dynslam_bench.core.settings import Settings
import numpy as np

class Removes:
    def __init__(self, settings):
        pass

    def reset(self, camera, *, rng):
        pass

    def track(self, frame):
        Path({image!r}).unlink(missing_ok=True)
        return TrackResult(np.eye(4), "ok")

SPEC = TrackerSpec(id="removes", entry_point=__file__ + ":Removes", label="removes", summary="", settings=Settings)
"""


def test_a_file_that_goes_in_mid_run_is_the_datas_fault(store: RunStore, damaged, tmp_path: Path) -> None:
    folder, image = damaged
    (tmp_path / "removes.py").write_text(REMOVES.format(image=str(image)))
    with pytest.raises(RunError, match=rf"frame {AT} of '.*' cannot be read: .*{image.name}"):
        run_one(RunSpec(tracker=f"{tmp_path}/removes.py:SPEC", sequence=folder), store)
    assert store.ids() == []


def test_a_recorded_mask_that_cannot_be_decoded_is_the_datas_fault(store: RunStore, damaged, tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    for index in range(FRAMES):
        cv2.imwrite(str(masks / f"{index:06d}.png"), np.zeros((120, 160), np.uint8))
    (masks / f"{AT:06d}.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    settings = {"segmentation.source": f"recorded:{masks}"}
    with pytest.raises(RunError, match=rf"frame {AT} of {FRAMES}: .*{AT:06d}\.png is truncated"):
        run_one(RunSpec(tracker="mask-rcnn", sequence=damaged[0], settings=settings), store)
    assert store.ids() == []


def test_what_a_tracker_raises_itself_stays_its_outcome(store: RunStore, damaged) -> None:
    record = run_one(RunSpec(tracker=TARGET, sequence=damaged[0], settings={"mode": "raise"}), store)
    assert (record.status, store.ids()) == ("crashed", [record.run_id])


def test_one_bad_sequence_stops_no_other(store: RunStore, damaged, tmp_path: Path) -> None:
    folder, image = damaged
    good = [str(shutil.copytree(folder, tmp_path / name)) for name in ("first", "second")]
    image.write_text("no image")
    missing = str(tmp_path / "missing")
    specs = [RunSpec(tracker="never-move", sequence=name) for name in (good[0], folder, missing, good[1])]
    told: list[tuple[str, str]] = []
    records = run_many(specs, results=store, on_fault=lambda spec, error: told.append((spec.sequence, str(error))))
    assert [record.place for record in records] == good and sorted(store.ids()) == sorted(r.run_id for r in records)
    assert [sequence for sequence, _ in told] == [missing, folder]
    with pytest.raises(DynslamError, match="missing"):  # nobody is told: raised at the end
        run_many(specs, results=store)
