"""Masks that were recorded come back as they were found."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.segmentation.recorded import RecordedSegmenter, label_image, record_masks
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.sequences.catalogue import open_sequence

ORACLE = SegmentationSettings(source="oracle")


@pytest.fixture(scope="module")
def sequence():
    return open_sequence("synthetic/walking_xyz?scene=0&frames=60", frames=(0, 3))


def test_recorded_masks_are_the_segmenters(sequence, tmp_path: Path) -> None:
    assert record_masks(sequence, tmp_path / "masks", ORACLE) == 3
    assert record_masks(sequence, tmp_path / "masks", ORACLE) == 0, "what is there is kept"
    recorded = RecordedSegmenter(tmp_path / "masks")
    assert recorded.missing(sequence.timestamps) == []
    for index in range(len(sequence)):
        found, exact = recorded.segment(sequence[index]).of_classes(["person"]), sequence.masks[index]
        people = {label for label, name in exact.class_names.items() if name == "person"}
        assert len(found) == len(people & set(np.unique(exact.instances).tolist())) > 0
        np.testing.assert_array_equal(found.union(), np.isin(exact.instances, list(people)))


def test_a_folder_of_other_masks_is_refused(sequence, tmp_path: Path) -> None:
    record_masks(sequence, tmp_path, ORACLE)
    (tmp_path / "other").mkdir()
    cv2.imwrite(str(tmp_path / "other" / "000000.png"), np.zeros((4, 4), np.uint8))
    for folder, change, words in (
        ("", {"confidence": 0.5}, r"holds other masks: confidence is '0\.3' there and '0\.5' now"),
        ("other", {}, "holds something else"),
        ("none", {"source": "none"}, "source=none has no masks to record"),
    ):
        with pytest.raises(SegmentationError, match=words):
            record_masks(sequence, tmp_path / folder, ORACLE.model_copy(update=change))


def test_numbers_stand_for_classes_in_every_frame() -> None:
    def objects(*names: str) -> Instances:
        masks = np.zeros((len(names), 2, 8), bool)
        for place in range(len(names)):
            masks[place, :, place : place + 2] = True
        scores = np.linspace(0.9, 0.5, len(names)).astype(np.float32)
        return Instances(masks, np.zeros((len(names), 4), np.float32), names, scores)

    table: dict[int, str] = {}
    first = label_image(objects("person", "chair", "person"), table)
    again = label_image(objects("chair", "person"), table)
    assert table == {1: "person", 2: "chair", 3: "person"}
    assert [table[int(v)] for v in first[0, :4]] == ["person", "person", "chair", "person"], "the surest is on top"
    assert [table[int(v)] for v in again[0, :3]] == ["chair", "chair", "person"]
    assert len(np.unique(first)) == 4
