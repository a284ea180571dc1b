"""What cannot run is refused before the run, in one line: it is no crash, and nothing is stored."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.folders import WEIGHTS_VARIABLE
from dynslam_bench.envs import SlamEnv
from dynslam_bench.runs import RunSpec, RunStore, run_many, run_one
from dynslam_bench.tuning import StudySpec, Tuner


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


def test_a_study_refuses_it_too(toy_folder: str, mistakes, tmp_path: Path) -> None:
    source, words = mistakes["no network"]
    spec = StudySpec.model_validate(
        {
            "name": "s",
            "tracker": "mask-rcnn",
            "tune": (toy_folder,),
            "trials": 2,
            "space": {"fixed": {"segmentation.source": source}},
        }
    )
    with pytest.raises(DynslamError, match=words):
        Tuner(spec, tmp_path / "results").run()
    assert RunStore(tmp_path / "results").ids() == []


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
