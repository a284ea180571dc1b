"""The demonstration's closing sentences follow its numbers, whatever they are."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from dynslam_bench.cli import demo as demo_story
from dynslam_bench.cli.demo import PROBE_FRAMES, PROBE_S, estimate, measure, tell
from dynslam_bench.core.records import digest
from dynslam_bench.reports.model.row import RunRow
from dynslam_bench.runs.record import SequenceInfo, TrackerInfo


def row(tracker: str, ate_m: float, sequence: str = "synthetic/walking_xyz?scene=100&frames=100") -> RunRow:
    return RunRow(
        run_id=digest([tracker, sequence], 16), status="ok", n_frames=100, tracker=TrackerInfo(id=tracker, label=tracker),
        sequence=SequenceInfo(id=sequence, part="0" * 16, frames=100, duration_s=3.3, fps=30, ground_truth=True),
        protocol_id="p", protocol_digest="d", hold_last_pose_ate_m=ate_m,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("culled_m", "verdict"),
    [
        (0.004, "Culling makes the error 5.0 times smaller."),
        (0.018, "Culling changes nothing that one run could show."),
        (0.06, "Culling makes the error 3.0 times larger."),
    ],
)
def test_the_verdict_is_that_of_the_numbers(culled_m: float, verdict: str) -> None:
    first, *_ = tell([row("orb-slam2", 0.02), row("mask-rcnn", culled_m), row("never-move", 0.1)], [])
    assert first == (
        f"Where people walk (walking_xyz?scene=100): 20.0 mm without culling (orb-slam2), {1e3 * culled_m:.1f} mm with "
        f"masks of people (mask-rcnn). {verdict}"
    )


def test_every_sequence_has_its_sentence_and_what_did_not_run_has_none() -> None:
    sitting = row("orb-slam2", 0.003, "synthetic/sitting_xyz?scene=104&frames=100")
    lines = tell([sitting, row("orb-slam2", 0.02), row("mask-rcnn", 0.004)], [])
    assert [line.split(":")[0] for line in lines[:2]] == [
        "Where people walk (walking_xyz?scene=100)", "Where people sit (sitting_xyz?scene=104)"
    ]  # fmt: skip
    assert lines[1].endswith("3.0 mm without culling (orb-slam2).") and len(lines) == 3, "no costs without records"
    assert "proves nothing" in lines[-1]


def test_what_culling_costs_is_the_median_frame_of_the_runs_that_ended_well() -> None:
    def record(tracker: str, median_s: float, failed: bool = False) -> SimpleNamespace:
        timings = {"processor": SimpleNamespace(median_s=median_s)}
        return SimpleNamespace(tracker=SimpleNamespace(id=tracker), timings=timings, failed=failed)

    records = [
        record("orb-slam2", 0.03),
        record("orb-slam2", 0.05),
        record("mask-rcnn", 0.1),
        record("mask-rcnn", 9, True),
    ]
    *_, costs, _ = tell([row("orb-slam2", 0.02)], records)
    assert costs == "What it costs, in processor time of the median frame: 40 ms (orb-slam2), 100 ms (mask-rcnn)."


def test_the_estimate_grows_with_what_is_asked_for() -> None:
    def minutes(*asked: int, slowness: float = 1.0, compiles: bool = False) -> int:
        return int(estimate(*asked, slowness=slowness, compiles=compiles).split()[1])

    usual = minutes(80, 20, 6, 2)
    assert usual < minutes(80, 20, 6, 2, compiles=True) < minutes(80, 20, 6, 2, compiles=True, slowness=3.0)
    assert minutes(600, 150, 30, 1) > 10 * usual
    assert "280 frames" in estimate(80, 20, 6, 2, slowness=1.0, compiles=False)


def test_the_speed_of_the_machine_is_measured_before_a_time_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([10.0, 10.0 + 3 * PROBE_S * PROBE_FRAMES])
    monkeypatch.setattr(demo_story, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    slowness, compiles = measure(1)
    assert slowness == pytest.approx(3.0) and isinstance(compiles, bool)
