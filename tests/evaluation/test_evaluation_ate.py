"""The ATE alone is the number of the whole evaluation, with lost frames left out and held."""

import numpy as np
import pytest

from dynslam_bench.core.errors import EvaluationError
from dynslam_bench.evaluation.ape import ate_rmse_m
from dynslam_bench.evaluation.evaluate import evaluate
from dynslam_bench.evaluation.protocol import get_protocol
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory

STAMPS = np.round(100 + np.arange(80) / 30, 6)


def tracks():
    """A true path at 90 Hz, and an estimate of it that lost twelve frames."""
    rng, t = np.random.default_rng(3), np.arange(260) / 90
    truth = Trajectory(100 + t, se3.exp(np.sin(t[:, None] * [1.0, 1.3, 0.7, 0.5, 0.4, 0.6])))
    nearest = np.abs(truth.timestamps[:, None] - STAMPS).argmin(0)
    poses = truth.T_world_cam[nearest] @ se3.exp(rng.normal(0, 0.01, (80, 6)))
    kept = np.r_[0:40, 52:80]
    return Trajectory(STAMPS[kept], poses[kept]), truth


@pytest.mark.parametrize("name", ["tum-rgbd/v1", "evo-default", "vslam-lab"])
def test_it_is_the_number_of_the_whole_evaluation(name):
    estimate, truth = tracks()
    found = []
    for policy, held_at in (("exclude", None), ("hold", STAMPS)):
        protocol = get_protocol(name).model_copy(update={"lost_frames": policy})
        whole = evaluate(estimate, truth, protocol, input_timestamps=STAMPS).metrics["ate_rmse_m"]
        found.append(ate_rmse_m(estimate, truth, protocol, held_at=held_at))
        assert found[-1] == pytest.approx(whole, rel=1e-12)
    assert found[1] > 2 * found[0], "holding still costs"


def test_what_cannot_be_compared_is_said():
    estimate, truth = tracks()
    with pytest.raises(EvaluationError, match="only one pose"):
        ate_rmse_m(estimate.select(slice(0, 1)), truth, get_protocol("tum-rgbd/v1"))
