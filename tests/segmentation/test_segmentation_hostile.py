"""Labels, checkpoints and recorded masks that somebody else made."""

from __future__ import annotations

import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from coco_file import coco

from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.segmentation.networks.backbone import NetworkConfig
from dynslam_bench.segmentation.networks.loading import FORMAT, load_network
from dynslam_bench.segmentation.networks.network import MaskRCNN
from dynslam_bench.segmentation.training.labelled_images import coco_images, decode_runs, yolo_images
from dynslam_bench.segmentation.training.prepared import PreparedImages

SMALL = NetworkConfig(blocks=(1, 1, 1, 1), bottleneck=False, stem=1, channels=1, classes=("person",), box_hidden=1,
                      mask_channels=1, mask_layers=1)  # fmt: skip


@pytest.mark.parametrize(
    "segmentation",
    [
        {"counts": [10**12, 10**12], "size": [6, 8]},
        {"counts": [-1, 49], "size": [6, 8]},
        {"counts": "0" * 5 + "o" * 100_000, "size": [6, 8]},
        {"counts": "o", "size": [6, 8]},
        {"counts": [64], "size": 8},
        {"counts": [1e400], "size": [6, 8]},
        [[1, 1, 1e300, 1, 1, 1e300]],
        [[0, 0, float("nan"), 1, 1, 1]],
        [["a", "b"]],
        [[1, 2, 3]],
        [10**400],
        "text",
    ],
)
def test_a_damaged_mask_is_one_clear_line(tmp_path: Path, segmentation: Any) -> None:
    images = coco_images(coco(tmp_path, segmentation))
    with pytest.raises(SegmentationError, match="a segmentation is"):
        images[0]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"images": [{"id": 1, "file_name": "../../etc/passwd"}]}, "does not lie in"),
        ({"images": [{"id": 1, "file_name": "/etc/passwd"}]}, "does not lie in"),
        ({"images": [{"id": "x"}]}, "is not in COCO's annotation format"),
        ({"images": None}, "is not in COCO's annotation format"),
        ({"annotations": [[]]}, "is not in COCO's annotation format"),
        ({"annotations": [{"image_id": 1e400}]}, "is not in COCO's annotation format"),
        ({"categories": {"a": 1}}, "is not in COCO's annotation format"),
    ],
)
def test_damaged_annotations_are_one_clear_line(tmp_path: Path, changes: dict[str, object], words: str) -> None:
    with pytest.raises(SegmentationError, match=words):
        coco_images(coco(tmp_path, [], changes=changes))


def test_run_lengths_of_any_text_end(tmp_path: Path) -> None:
    assert decode_runs(":d0R1") == [10, 20, 34 + 10 - 10]
    for text in ("o" * 10**6, "o", "Ω"):
        with pytest.raises(ValueError, match=r"the run lengths are damaged"):
            decode_runs(text * 20)


@pytest.mark.parametrize(
    "line", [b"-1 0 0 1 1 0 1", b"0 nan 0 1 1 0 1", b"99 0 0", b"\xff", b"0 1e300 0 1 1 1 0", b"9" * 5000]
)
def test_damaged_yolo_labels_are_one_clear_line(tmp_path: Path, line: bytes) -> None:
    for folder in ("images", "labels"):
        (tmp_path / folder).mkdir()
    cv2.imwrite(str(tmp_path / "images" / "a.png"), np.zeros((8, 8, 3), np.uint8))
    (tmp_path / "labels" / "a.txt").write_bytes(line)
    with pytest.raises(SegmentationError, match=r"is no polygon label|is not a text file"):
        yolo_images(tmp_path)[0]


def refused(path: Path, content: object, words: str) -> None:
    torch.save(content, path)
    with pytest.raises(SegmentationError, match=words):
        load_network(path)


def test_a_checkpoint_that_claims_a_huge_network_costs_nothing(tmp_path: Path) -> None:
    state = MaskRCNN(SMALL).state_dict()
    huge = SMALL.model_copy(update={"stem": 4096, "channels": 4096, "box_hidden": 4096}).model_dump_json()
    for config, words in (
        (huge, r"\d+ shapes differ"),
        (huge.replace("4096", "99999999"), "the network's shape is not understood"),
    ):
        refused(tmp_path / "net.pt", {"format": FORMAT, "config": config, "model": state}, words)


@pytest.mark.parametrize(
    "value", [torch.zeros(1).expand(10**6, 10**6), torch.zeros(4).to_sparse(), torch.zeros(4) * 1j]
)
def test_weights_that_are_no_plain_numbers_are_refused(tmp_path: Path, value: torch.Tensor) -> None:
    state = {**MaskRCNN(SMALL).state_dict(), "backbone.body.conv1.weight": value}
    refused(tmp_path / "net.pt", state, "is no plain array of numbers")


class Command:
    """What an attacker pickles."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("touch owned",)


def test_a_checkpoint_runs_no_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"a": Command()}, "new.pt")
    torch.save({"a": Command()}, "old.pt", _use_new_zipfile_serialization=False)
    Path("plain.pt").write_bytes(pickle.dumps(Command()))
    for name in ("new.pt", "old.pt", "plain.pt"):
        with pytest.raises(SegmentationError, match="is no torch checkpoint of plain weights"):
            load_network(Path(name))
    assert not Path("owned").exists()


def test_a_checkpoint_that_unpacks_to_far_more_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "net.pt", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(1 << 22))
    with pytest.raises(SegmentationError, match="it claims to unpack to 4194304 bytes"):
        load_network(tmp_path / "net.pt")


def test_damaged_prepared_images_are_one_clear_line(tmp_path: Path) -> None:
    np.save(tmp_path / "pickled.npy", np.array([Command()]), allow_pickle=True)
    np.save(tmp_path / "labels.npy", np.zeros((1, 2, 2), np.uint8))
    (tmp_path / "names.json").write_text("[[]]")
    for content in (b"", b"x" * 99, (tmp_path / "pickled.npy").read_bytes()):
        (tmp_path / "images.npy").write_bytes(content)
        with pytest.raises(SegmentationError, match=r"the prepared images in .* are damaged"):
            PreparedImages(tmp_path, ("person",))


def test_a_network_that_is_only_compared_with_a_file_is_made_of_shapes_alone(monkeypatch):
    """Numbers on torch's ``meta`` device take its compiler, and seconds to load that in every run."""

    def drawn(*_: object, **__: object) -> None:
        raise AssertionError("numbers are drawn")

    monkeypatch.setattr(torch.Tensor, "normal_", drawn)
    with torch.device("meta"):
        network = MaskRCNN(SMALL)
    assert all(weight.is_meta for weight in network.parameters())
    assert all(not cell.is_meta for cell in network.rpn._cells)  # made of numbers, so not made there
