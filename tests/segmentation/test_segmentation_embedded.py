"""The network in the package: it is found, small, runs offline, and sees rendered people."""

import numpy as np
import pytest

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.segmentation.build_segmenter import build_segmenter, resolve_source, weights_digest
from dynslam_bench.segmentation.networks.checkpoints import embedded_weights
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.sequences.catalogue import open_sequence

AUTO = SegmentationSettings()


def test_auto_means_embedded_on_rendered_sequences():
    assert embedded_weights().stat().st_size < 15e6
    assert resolve_source(AUTO, "synthetic/walking_xyz?scene=0&frames=60") == "embedded"
    assert len(weights_digest(AUTO, "synthetic/walking_xyz")) == 12
    assert f'"{weights_digest(AUTO, "synthetic/walking_xyz")}"' in embedded_weights().with_suffix(".json").read_text()


def test_it_finds_people_of_a_held_out_instance(tmp_path):
    segmenter = build_segmenter(AUTO, sequence_id="synthetic/walking_xyz", threads=1)
    sequence = open_sequence("synthetic/sitting_xyz?scene=120&frames=30", data_root=tmp_path)
    frame, masks = sequence[5], sequence.masks[5]
    people = np.isin(masks.instances, [k for k, name in masks.class_names.items() if name == "person"])
    found, again = segmenter.segment(frame), segmenter.segment(frame)
    union = found.union()
    assert set(found.class_names) == {"person"} and len(found) == 2
    assert (union & people).sum() / (union | people).sum() > 0.85
    assert np.array_equal(found.masks, again.masks) and np.array_equal(found.scores, again.scores)


@pytest.mark.parametrize("shape", [(480, 640, 3), (97, 211, 3)])
def test_nobody_there(shape):
    segmenter = build_segmenter(AUTO, sequence_id="synthetic/walking_xyz")
    found = segmenter.segment(Frame(0, 0.0, np.full(shape, 128, np.uint8), np.zeros(shape[:2], np.float32)))
    assert found.masks.shape == (0, *shape[:2])
