"""The stage cache in a whole tracker: the same bits, no network loaded where none is needed, honest times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.sequences.synthetic import open_synthetic
from dynslam_bench.trackers import TrackerContext, build_tracker

FRAMES = 4


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory):
    return open_synthetic(f"synthetic/walking_xyz@5?frames={FRAMES}", tmp_path_factory.mktemp("rendered"))


def run(sequence, cache: Path | None, **settings: object):
    """Poses ``[N, 4, 4]`` and the results of a run with the embedded network."""
    context = TrackerContext(sequence_id=sequence.id, cache=None if cache is None else str(cache))
    tracker = build_tracker("emfoa-oft", {"segmentation.source": "embedded", **settings}, context)
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    results = [tracker.track(sequence[index]) for index in range(len(sequence))]
    return np.array([result.T_world_cam for result in results]), results


def test_cached_runs_have_the_same_bits_and_load_no_network(
    sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, _ = run(sequence, None)
    cold, filled = run(sequence, tmp_path)
    assert [result.stats["cached_stages"] for result in filled] == [0.0] * FRAMES

    def refuse(*_: object) -> None:
        raise AssertionError("a network was loaded although all masks are stored")

    monkeypatch.setattr("dynslam_bench.segmentation.build.build_embedded", refuse)
    warm, found = run(sequence, tmp_path, **{"epipolar.threshold_px": 2.0, "segmentation.confidence": 0.35})
    again, _ = run(sequence, tmp_path)
    assert [result.stats["cached_stages"] for result in found] == [2.0] * FRAMES
    assert np.array_equal(plain, cold) and np.array_equal(plain, again)
    assert warm.shape == plain.shape
    for before, after in zip(filled, found, strict=True):
        cost = before.timings["segmentation"]
        assert after.timings["segmentation"] == pytest.approx(cost, rel=0.5), "told as what it costs, not the look-up"


def test_a_missing_file_is_an_error_at_once_with_the_cache_too(sequence, tmp_path: Path) -> None:
    with pytest.raises(SegmentationError, match=r"nowhere\.onnx"):
        run(sequence, tmp_path, **{"segmentation.source": f"onnx:{tmp_path / 'nowhere.onnx'}"})
