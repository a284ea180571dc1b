"""The room of contracts: complete, light, and the same objects as in the rooms that use them."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dynslam_bench.contracts import Frame, TrackResult, Trajectory
from dynslam_bench.contracts.checks import (
    STATES,
    TrackerContractError,
    blemishes,
    check_result,
    faults,
    trajectory_faults,
)
from dynslam_bench.geometry import se3

ALL = ("torch", "cv2", "numba", "scipy", "gymnasium", "optuna", "pandas")
LIGHT = {
    "import dynslam_bench": (*ALL, "numpy", "typer", "pydantic"),
    "import dynslam_bench.contracts": ALL,
    "import dynslam_bench.gate.pytest_plugin": ALL,
    "import dynslam_bench.sequences.synthetic": ("numba", "cv2", "torch"),
    "from dynslam_bench.trackers import TRACKERS; assert len(TRACKERS.all()) > 30": (
        "torch",
        "cv2",
        "gtsam",
        "numba",
    ),
    "import dynslam_bench.testing.pytest_plugin": ("cv2", "torch"),
    "import dynslam_bench.segmentation.build_segmenter": ("cv2", "torch"),
    "import dynslam_bench.segmentation.training.settings, dynslam_bench.segmentation.networks.checkpoints": (
        "cv2",
        "torch",
    ),
}
"""What people run often, the lightest first, and what it may not load."""
ROOT = Path(__file__).resolve().parents[2]
FRAME = Frame(3, 0.1, np.zeros((4, 6, 3), np.uint8), np.zeros((4, 6), np.float32))


@pytest.mark.slow
def test_what_is_run_often_loads_nothing_heavy() -> None:
    command = (
        f"import sys\nfor code, names in {LIGHT}.items():\n"
        "    exec(code)\n    print(*[f'{code} loads {name}' for name in names if name in sys.modules], sep='\\n')"
    )
    assert subprocess.check_output(
        [sys.executable, "-c", command], text=True, cwd=ROOT
    ) == "\n" * len(LIGHT)


def given(**changes: object) -> TrackResult:
    return TrackResult(**{"T_world_cam": np.eye(4), "state": "ok", **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("result", "words"),
    [
        (np.eye(4), "a ndarray, not a TrackResult"),
        (given(state="fine"), "state 'fine'"),
        (given(T_world_cam=None), "state 'ok' without a pose"),
        (given(T_world_cam=np.eye(3)), "an array of shape (3, 3) as pose"),
        (given(T_world_cam=np.full((4, 4), np.nan)), "a pose with 16 values that are not finite"),
        (
            given(T_world_cam=np.diag([2.0, 2.0, 2.0, 1.0])),
            "a pose that is no rigid transformation",
        ),
        (
            given(T_world_cam=np.diag([-1.0, 1.0, 1.0, 1.0])),
            "a pose that is no rigid transformation",
        ),
        (
            given(T_world_cam=se3.from_matrix(np.array([0, 0, 1e200]), np.eye(3))),
            "a pose 1e+200 m away",
        ),
        ("nonsense", "a str, not a TrackResult"),
        (given(T_world_cam=np.eye(4, dtype=complex)), "a pose of the type complex128"),
        (given(T_world_cam=np.eye(4).astype(object)), "a pose of the type object"),
        (given(T_world_cam=np.eye(4).astype(str)), "a pose of the type <U32"),
        (given(T_world_cam=np.eye(4, dtype=bool)), "a pose of the type bool"),
        (given(T_world_cam=np.eye(4, dtype=np.float16)), "a pose of the type float16"),
        (given(dynamic_mask=np.zeros((4, 4), bool)), "a dynamic mask of shape (4, 4)"),
        (given(stats=None), "stats of type NoneType"),
        (given(stats={"n": np.zeros(2)}), "stats with values that are no numbers"),
        (given(timings={"t": "soon"}), "timings with values that are no numbers"),
        (given(keypoints_xy=np.zeros(4, np.float32)), "keypoints_xy of shape (4,)"),
        (given(keypoints_xy=[[1.0, 2.0]]), "keypoints_xy of shape (1, 2) as list"),
        (given(keypoints_xy=np.full((2, 2), np.nan)), "keypoints_xy that are not finite"),
        (given(keypoints_keep=np.ones(3, bool)), "keypoints_keep that does not fit"),
    ],
)
def test_faults(result: object, words: str) -> None:
    assert [fault.found[: len(words)] for fault in faults(result, FRAME)] == [words]
    with pytest.raises(TrackerContractError, match="frame 3"):
        check_result(result, FRAME, "mine")


TURNED = se3.exp(np.array([3.0, -2.0, 1.0, 0.3, -0.7, 1.1]))


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.longdouble, ">f4", np.int64])
def test_a_pose_of_any_real_type_is_taken_as_float64(dtype: object) -> None:
    expected = np.eye(4) if dtype is np.int64 else TURNED
    pose = check_result(given(T_world_cam=expected.astype(dtype)), FRAME, "mine").T_world_cam
    assert pose is not None
    assert pose.dtype == np.float64
    assert np.abs(pose - expected).max() < 3e-7


@pytest.mark.parametrize(
    ("result", "words"),
    [
        (given(stats={"n": float("nan")}), "stats with values"),
        (given(timings={"t": float("nan")}), "timings with values"),
        (given(timings={"t": -1.0}), "a timing that is negative"),
        (given(dynamic_mask=np.zeros((4, 6), np.uint8)), "a dynamic mask of type uint8"),
        (given(motion_covariance=np.eye(3)), "a motion covariance of shape (3, 3)"),
        (given(motion_covariance="sure"), "a motion covariance of shape ()"),
        (given(motion_covariance=np.full((6, 6), np.nan)), "a motion covariance of shape (6, 6)"),
        (given(motion_covariance=np.zeros((6, 6))), "a motion covariance that is not pos"),
        (given(motion_covariance=np.triu(np.ones((6, 6)))), "a motion covariance that is not sym"),
        (
            given(motion_covariance=1e-9 * (np.eye(6) + np.triu(np.full((6, 6), 0.01), 1))),
            "a motion covariance that is not sym",
        ),
        (given(motion_covariance=1e-9 * np.ones((6, 6))), "a motion covariance that is not pos"),
    ],
)
def test_blemishes_are_no_faults(result: TrackResult, words: str) -> None:
    assert not list(faults(result, FRAME))
    assert [fault.found[: len(words)] for fault in blemishes(result)] == [words]


def test_a_covariance_is_taken_in_float64_and_none_costs_a_run() -> None:
    taken = check_result(given(motion_covariance=np.eye(6, dtype=np.float32)), FRAME, "mine")
    assert taken.motion_covariance is not None
    assert taken.motion_covariance.dtype == np.float64
    assert (taken.motion_covariance == np.eye(6)).all()
    row = check_result(given(motion_covariance=np.eye(6).ravel().tolist()), FRAME, "mine")
    assert row.motion_covariance is not None
    assert (row.motion_covariance == np.eye(6)).all()
    for wrong in (np.eye(3), "sure", [[1, 2], [3]], {"a": 1}, np.ones((4, 9)), np.ones((1, 36))):
        taken = check_result(given(motion_covariance=wrong), FRAME, "mine")
        assert taken.motion_covariance is not None
        assert np.isnan(taken.motion_covariance).all()
    assert check_result(given(), FRAME, "mine").motion_covariance is None


@pytest.mark.parametrize("state", STATES)
def test_a_good_result_has_neither(state: str) -> None:
    result = given(state=state, stats={"matches": 3}, timings={"all": 0.01})
    assert not list(faults(result, FRAME))
    assert not list(blemishes(result))
    assert check_result(result, FRAME, "mine").stats == {"matches": 3.0}


def test_a_final_trajectory_is_one() -> None:
    assert [fault.found for fault in trajectory_faults(np.eye(4))] == [
        "a ndarray, not a Trajectory"
    ]
    assert not list(trajectory_faults(Trajectory(np.array([0.0, 1.0]), np.stack([np.eye(4)] * 2))))
