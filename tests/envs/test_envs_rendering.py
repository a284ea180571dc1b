"""The rendered picture."""

from __future__ import annotations

import numpy as np
import pytest
from envs_toys import TARGET, ToySequence

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.envs import SlamEnv
from dynslam_bench.envs.rendering import (
    ALIGN_FROM,
    CULLED,
    ESTIMATE,
    HEIGHT,
    KEPT,
    MASK,
    STRIP,
    TRUTH,
    VIEWS,
    align_to_truth,
    main_view,
)
from dynslam_bench.evaluation.online import OnlineError


def pixels(image: np.ndarray, colour: tuple[int, int, int]) -> int:
    return int((image == np.array(colour, np.uint8)).all(axis=2).sum())


def rendered(steps: int = 11, **kwargs) -> np.ndarray:
    sequence = kwargs.pop("sequence", ToySequence(12))
    env = SlamEnv(sequence, TARGET, render_mode="rgb_array", **kwargs)
    env.reset(seed=0)
    for _ in range(steps):
        env.step(0)
    image = env.render()
    assert image is not None and image.dtype == np.uint8
    return image


def test_size_is_even_and_the_same_for_every_frame() -> None:
    shapes = {rendered(steps).shape for steps in (0, 1, 11)}
    assert shapes == {(HEIGHT + STRIP, 640 + HEIGHT, 3)}
    assert (HEIGHT + STRIP) % 2 == 0


def test_kept_and_culled_features_and_the_mask_are_drawn_in_their_colours() -> None:
    picture = rendered()[:HEIGHT, :640]
    assert pixels(picture, KEPT) > pixels(picture, CULLED) > 50
    orange = np.abs(picture[240, 160:200].astype(float).mean(axis=0) - MASK)
    plain = np.abs(picture[240, 500:600].astype(float).mean(axis=0) - MASK)
    assert orange.sum() < plain.sum()


def test_estimate_and_truth_are_drawn_from_above() -> None:
    plot = rendered()[:HEIGHT, 640:]
    assert pixels(plot, ESTIMATE) > 200 and pixels(plot, TRUTH) > 20
    columns = np.argwhere((plot == np.array(ESTIMATE, np.uint8)).all(axis=2))[:, 1]
    assert columns.max() - columns.min() > 300  # the toy camera walks to the right, which fills the plot


def test_no_ground_truth_and_lost_frames_are_no_trouble() -> None:
    rendered(sequence=ToySequence(12, has_truth=False))
    rendered(settings={"mode": "lost", "at": 3, "until": 6})
    rendered(settings={"mode": "initialising", "at": 0})


def test_the_path_is_seen_in_the_view_in_which_it_spreads_most() -> None:
    along = np.linspace(0, 1, 50)[:, None]
    flat = {(1, 0.1, 0.5): "from above", (1, 0.5, 0.1): "from behind", (0.1, 0.5, 1): "from the side"}
    for spread, name in flat.items():
        assert main_view(np.sin(along * [5, 9, 13]) * spread).startswith(name)
    assert main_view(np.zeros((0, 3))) == main_view(along * [1, 0, 0]) == next(iter(VIEWS))
    assert (VIEWS[main_view(np.zeros((1, 3)))] @ [1.0, 2.0, 3.0]).tolist() == [1.0, 3.0]


def test_the_error_in_the_picture_is_the_protocols() -> None:
    env = SlamEnv(ToySequence(45), TARGET, render_mode="rgb_array")
    env.reset(seed=0)
    online, stamps = OnlineError(env.sequence.ground_truth), env.sequence.timestamps
    truth = {index: online.truth_at(float(stamp)) for index, stamp in enumerate(stamps)}
    for index in range(45):
        if index:
            env.step(0)
        ate_m = align_to_truth(env.episode, truth)[2]
        assert (ate_m is None) == (index + 1 < ALIGN_FROM)
    assert ate_m == pytest.approx(env.episode_metrics()["ate_rmse_m"], rel=1e-6)


def test_render_without_reset_or_mode() -> None:
    with pytest.raises(DynslamError):
        SlamEnv(ToySequence(12), TARGET, render_mode="rgb_array").render()
    env = SlamEnv(ToySequence(12), TARGET)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="without a render mode"):
        assert env.render() is None
