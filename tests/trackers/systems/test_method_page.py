"""What `docs/explanation/paper.md` says of each equation: the trackers run what it says they run."""

import numpy as np
import pytest
from quick_dense import QUICK_DENSE

from dynslam_bench.flow import dense_flow as dense
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.trackers import TrackerContext, build_tracker


@pytest.mark.parametrize(("name", "terms"), [("emfoa-oft", 1), ("emfoa-oft-paper", 3)])
def test_the_papers_tracker_runs_eq_1_to_3_and_ours_the_first_term(monkeypatch, name: str, terms: int) -> None:
    sequence = open_sequence("synthetic/walking_xyz?frames=9")
    calls: list[bool] = []
    chosen = dense.aggregate_and_choose

    def spy(*arguments) -> None:
        calls.append(bool(arguments[8].appearance))
        chosen(*arguments)

    monkeypatch.setattr(dense, "aggregate_and_choose", spy)
    quick = QUICK_DENSE | {"flow.second_round": True} if terms == 3 else {}
    context = TrackerContext(sequence_id=sequence.id, masks=sequence.masks)
    tracker = build_tracker(name, {"segmentation.source": "oracle", **quick}, context)
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    stats = [tracker.track(sequence[index]).stats for index in range(2)][1]
    assert stats["flow_valid"] > 100 and stats["epipolar_f_asked"] == 1
    assert terms == 1 or stats["epipolar_f_judged"] == 1, "the paper knows no guard"
    assert calls == [True] * (4 if terms == 3 else 0)  # there and back, two rounds
