"""Covariances of a tracker's motions: stored with its run, scored, and stated where they are none."""

import re
from pathlib import Path

import numpy as np
import pytest
from helpers.envs_toys import truth, write_folder

from dynslam_bench.cli.runs import covariance_words
from dynslam_bench.envs.episode import FrameOutcome
from dynslam_bench.geometry import Trajectory, write_tum
from dynslam_bench.geometry.motion_covariances import read_motion_covariances
from dynslam_bench.runs import RunSpec, RunStore, run_one, score
from dynslam_bench.runs.bank import Bank
from dynslam_bench.runs.frames import FRAMES_FILE, FrameLog, FrameRow
from dynslam_bench.runs.layout import COVARIANCES
from dynslam_bench.runs.rows import make_run_row

PLUGIN = """
import numpy as np
from dynslam_bench.contracts import TrackerSpec, TrackResult
from dynslam_bench.core.settings import Settings
from dynslam_bench.geometry import read_tum, se3

class SureSettings(Settings):
    gives: str = "right"
    truth: str = ""

class Sure:
    # errors of 1 mm and 1 mrad on true poses; two poses have independent errors
    def __init__(self, settings):
        self.gives = settings.gives
        self.poses = read_tum(settings.truth).T_world_cam

    def reset(self, camera, *, rng):
        self.rng = rng

    def track(self, frame):
        pose = self.poses[frame.index] @ se3.exp(self.rng.normal(0, 1e-3, 6))
        covariance = np.eye(6) * 2e-6
        given = {
            "right": covariance,
            "zeros": np.zeros((6, 6)),
            "nan": np.full((6, 6), np.nan),
            "huge": np.eye(6) * 1e12,
            "millimetres": np.diag([2.0] * 3 + [2e-6] * 3),
            "asymmetric": covariance + np.triu(np.full((6, 6), 1e-7), 1),
            "text": "very",
        }
        return TrackResult(pose, "ok", motion_covariance=given[self.gives])

SPEC = TrackerSpec(id="sure", entry_point=f"{__file__}:Sure", label="Sure", settings=SureSettings)
"""


def test_a_log_gives_back_what_a_tracker_gave(tmp_path: Path) -> None:
    matrix = np.full((6, 6), np.nan)
    matrix[0, 0] = 1e12
    outcomes = [
        FrameOutcome(0, 1.0, "ok", np.eye(4), {}, {}, None),
        FrameOutcome(1, 1.1, "ok", np.eye(4), {}, {}, None, motion_covariance=matrix),
    ]
    lines = [FrameRow.of(outcome).to_json() for outcome in outcomes]
    (tmp_path / FRAMES_FILE).write_text("".join(lines))
    log = FrameLog.read(tmp_path / FRAMES_FILE)
    assert not log.damage
    assert len(log.motion_covariances()) == 1
    log.write(tmp_path, "")
    back = read_motion_covariances(tmp_path / COVARIANCES)
    assert back.timestamps == pytest.approx([1.1])
    assert np.array_equal(back.matrices[0], matrix, equal_nan=True)
    # a tracker that gives none leaves no file
    (tmp_path / COVARIANCES).unlink()
    FrameLog(log.rows[:1]).write(tmp_path, "")
    assert not (tmp_path / COVARIANCES).exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gives", "words"),
    [
        ("right", ""),
        ("zeros", "11 of 11 motions have a covariance that is not positive definite"),
        ("nan", "11 of 11 motions have no covariance, or none of 6x6 numbers"),
        ("huge", "the covariances do not fit the errors: NEES / 6 is"),
        ("millimetres", "standard deviations of translation .*as in millimetres"),
        ("asymmetric", "11 of 11 motions have a covariance that is not symmetric"),
        ("text", "11 of 11 motions have no covariance, or none of 6x6 numbers"),
    ],
)
def test_runs_score_covariances_and_state_their_faults(
    store: RunStore, tmp_path: Path, gives: str, words: str
) -> None:
    plugin = tmp_path / "sure.py"
    plugin.write_text(PLUGIN)
    poses = truth(12)
    write_tum(tmp_path / "poses.txt", Trajectory(np.arange(12.0), poses))
    spec = RunSpec(
        tracker=f"{plugin}:SPEC",
        sequence=str(write_folder(tmp_path / "toy", 12)),
        settings={"gives": gives, "truth": str(tmp_path / "poses.txt")},
    )
    record = run_one(spec, store)
    assert record.status == "ok", record.reason
    assert COVARIANCES in record.files
    metrics = score(store, record)
    assert metrics.online is not None
    about = [line for line in metrics.online.warnings if "covariance" in line]
    if not words:
        assert not about
        assert 0.2 < metrics.metrics["nees_1f_mean"] < 3
        assert "within the 95 % ellipsoid" in covariance_words(make_run_row(record, metrics))
        # a bank holds all that scores are computed from
        bank = Bank(tmp_path / "bank")
        bank.prepare()
        copied = bank.copy_from(store, record)
        assert bank.changed(copied) == ""
        assert score(bank, copied).metrics["nees_1f_mean"] == metrics.metrics["nees_1f_mean"]
        return
    (line,) = about
    assert re.search(words, line)
