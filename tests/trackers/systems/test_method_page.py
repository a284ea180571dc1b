"""What `docs/method.md` says of each equation: the files exist, and the trackers run what it says they run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from quick_dense import QUICK_DENSE

import dynslam_bench
from dynslam_bench.flow import dense_flow as dense
from dynslam_bench.flow import dense_kernels as aggregation
from dynslam_bench.flow.dense_flow import DenseDaisyFlow
from dynslam_bench.flow.sparse import SparseDaisyFlow
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.slam.pipeline import SlamPipeline
from dynslam_bench.trackers import TrackerContext, build_tracker

ROOT = Path(__file__).resolve().parents[3]
PACKAGE = Path(dynslam_bench.__file__).parent


def test_the_papers_tracker_runs_eq_1_to_3_and_ours_the_first_term(monkeypatch) -> None:
    sequence = open_sequence("synthetic/walking_xyz?frames=9")
    calls: list[bool] = []
    chosen = dense.aggregate_and_choose

    def spy(*arguments: object) -> None:
        calls.append(bool(arguments[8].appearance))  # type: ignore[attr-defined]
        chosen(*arguments)

    monkeypatch.setattr(dense, "aggregate_and_choose", spy)
    assert chosen is aggregation.aggregate_and_choose
    context = TrackerContext(sequence_id=sequence.id, masks=sequence.masks)
    quick = QUICK_DENSE | {"flow.second_round": True}
    for name, kind, terms in (("emfoa-oft", SparseDaisyFlow, 1), ("emfoa-oft-paper", DenseDaisyFlow, 3)):
        calls.clear()
        tracker = build_tracker(name, {"segmentation.source": "oracle", **(quick if terms == 3 else {})}, context)
        assert isinstance(tracker, SlamPipeline) and isinstance(tracker._flow, kind)
        assert tracker._flow.settings.terms == terms
        tracker.reset(sequence.camera, rng=np.random.default_rng(0))
        results = [tracker.track(sequence[index]) for index in range(2)]
        assert results[1].stats["flow_valid"] > 100
        assert results[1].stats["epipolar_f_asked"] == 1
        assert terms == 1 or results[1].stats["epipolar_f_judged"] == 1, "the paper knows no guard"
        assert len(calls) == (4 if terms == 3 else 0) and all(calls)  # there and back, two rounds
