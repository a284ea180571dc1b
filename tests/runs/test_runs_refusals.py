"""What cannot run, and what raises outside the tracker's own code, is no outcome: one line, and nothing is stored."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from envs_toys import TARGET, write_folder

from dynslam_bench.core.errors import DynslamError, RunError
from dynslam_bench.core.folders import WEIGHTS_VARIABLE
from dynslam_bench.envs import SlamEnv
from dynslam_bench.runs import RunSpec, RunStore, run_many, run_one


@pytest.fixture
def mistakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, tuple[str, str]]:
    """A name for each mistake: what is set as the source, and the words of the error."""
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "weights"))
    (tmp_path / "garbage.onnx").write_bytes(b"no network at all" * 20)
    (tmp_path / "masks").mkdir()
    for index in range(20):
        cv2.imwrite(str(tmp_path / "masks" / f"{index:06d}.png"), np.zeros((120, 160), np.uint8))
    return {
        "no onnx": (f"onnx:{tmp_path}/none.onnx", r"cannot read the network .*none\.onnx"),
        "no network": (f"onnx:{tmp_path}/garbage.onnx", r"garbage\.onnx is not an ONNX model \(340 bytes\)"),
        "no weights": (f"weights:{tmp_path}/none.pt", r"cannot read the checkpoint .*none\.pt"),
        "no checkpoint": (f"weights:{tmp_path}/garbage.onnx", r"is no torch checkpoint of plain weights"),
        "no folder": (f"recorded:{tmp_path}/none", r"recorded masks .*none does not exist"),
        "too few masks": (f"recorded:{tmp_path}/masks", r"has none for 40 of 60 frames of '.*', the first is frame 20"),
        "oracle": ("oracle", r"has no exact masks"),
        "auto": ("auto", r"no masks for .*COCO checkpoint \(170 MB\).*onnx:PATH"),
        "plugin": ("plugin:mine", r"unknown segmenter 'mine'"),
    }


NAMES = (
    "no onnx",
    "no network",
    "no weights",
    "no checkpoint",
    "no folder",
    "too few masks",
    "oracle",
    "auto",
    "plugin",
)


@pytest.mark.parametrize("name", NAMES)
def test_masks_that_cannot_be_had(store: RunStore, toy_folder: str, mistakes, name: str) -> None:
    source, words = mistakes[name]
    settings = {"segmentation.source": source}
    spec = RunSpec(tracker="mask-rcnn", sequence=toy_folder, settings=settings)
    for attempt in (
        lambda: run_one(spec, store),
        lambda: run_many([RunSpec(tracker="never-move", sequence=toy_folder), spec], results=store),
        lambda: SlamEnv(toy_folder, "mask-rcnn", settings=settings),
    ):
        with pytest.raises(DynslamError, match=words) as caught:
            attempt()
        assert "\n" not in str(caught.value)
    assert store.ids() == []


def test_coco_without_a_network(store: RunStore, toy_folder: str, monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "weights"))

    def refuse(*args: object, **kwargs: object) -> None:
        raise OSError("network is unreachable")

    monkeypatch.setattr("urllib.request.OpenerDirector.open", refuse)
    spec = RunSpec(tracker="mask-rcnn", sequence=toy_folder, settings={"segmentation.source": "coco"})
    with pytest.raises(DynslamError, match=r"cannot fetch the checkpoint 'coco': .*network is unreachable \(put"):
        run_one(spec, store)
    assert store.ids() == []


def test_the_hint_of_auto_is_one_that_the_system_takes(store: RunStore, toy_folder: str, mistakes) -> None:
    def hint(tracker: str) -> str:
        spec = RunSpec(tracker=tracker, sequence=toy_folder, settings={"segmentation.source": "auto"})
        with pytest.raises(DynslamError) as caught:
            run_one(spec, store)
        return caught.value.options[-1]

    assert "segmentation.source=none" not in hint("mask-rcnn") and "emfoa-oft?masks=none" in hint("mask-rcnn")


@pytest.mark.parametrize(
    ("tracker", "words"),
    [
        ("replay", "replay needs a trajectory file"),
        ("replay:/no/such/file.txt", r"/no/such/file\.txt"),
        ("subprocess:/no/such/program", "cannot start '/no/such/program'"),
    ],
)
def test_files_that_are_not_there(store: RunStore, toy_folder: str, tracker: str, words: str) -> None:
    with pytest.raises(DynslamError, match=words):
        run_one(RunSpec(tracker=tracker, sequence=toy_folder), store)
    with pytest.raises(DynslamError, match=words):
        SlamEnv(toy_folder, tracker)
    assert store.ids() == []


def test_what_only_the_run_can_find_out_is_refused_likewise(store: RunStore, toy_folder: str, tmp_path: Path) -> None:
    """A plug-in that finds its own settings unfit when it is built, in the child."""
    (tmp_path / "picky.py").write_text(
        "from dynslam_bench.core.errors import SettingsError\n"
        "from dynslam_bench.trackers import TrackerSpec\n"
        "def build(settings):\n"
        "    raise SettingsError('the calibration file is missing', 'set calibration=FILE')\n"
        "SPEC = TrackerSpec('picky', f'{__file__}:build', 'Picky')\n"
    )
    with pytest.raises(DynslamError, match=r"picky cannot run on .*: frame 0 of 60: the calibration file is missing"):
        run_one(RunSpec(tracker=f"{tmp_path}/picky.py:SPEC", sequence=toy_folder), store)
    assert store.ids() == []


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
