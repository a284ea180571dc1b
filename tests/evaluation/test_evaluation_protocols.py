"""Protocols: frozen, told apart, described, and how far their numbers lie apart."""

import pytest
from evaluation_walks import noisy, turned, walk

from dynslam_bench.core.errors import EvaluationError
from dynslam_bench.evaluation import (
    Protocol,
    RPESpec,
    compare_protocols,
    get_protocol,
)


def test_protocols_are_frozen_told_apart_and_described():
    tum = get_protocol("tum-rgbd/v1")
    assert get_protocol(tum) is tum
    assert tum.digest() == "1190f97bbd77"  # stored with every number: a change of v1 is a new version
    for change in ({"max_dt": 0.03}, {"strict": False}, {"alignment": "sim3"}, {"lost_frames": "hold"}, {"rpe": ()}):
        assert tum.model_copy(update=change).digest() != tum.digest()
    with pytest.raises(Exception, match="frozen"):
        tum.max_dt = 1.0
    assert "1190f97bbd77" in tum.describe()
    assert Protocol.model_validate_json(tum.model_dump_json()) == tum


def test_unknown_protocol_has_a_did_you_mean():
    with pytest.raises(EvaluationError, match=r"unknown protocol 'tum-rgbd'.*did you mean 'tum-rgbd/v1'"):
        get_protocol("tum-rgbd")


def test_a_delta_in_frames_is_whole():
    with pytest.raises(ValueError, match="whole number"):
        RPESpec(delta=1.5, unit="f")
    with pytest.raises(ValueError, match="all pairs are taken over frames"):
        RPESpec(delta=1.0, unit="m", pairs="all")


def test_compare_protocols_shows_how_far_they_are_apart():
    truth = walk(n=400)
    rows = compare_protocols(turned(noisy(truth), 2), truth)
    by_label = {row.label: row for row in rows}
    assert (
        by_label["not aligned"].rmse_m
        > by_label["origin-aligned"].rmse_m
        > by_label["SE(3)-aligned (TUM's ATE)"].rmse_m
    )
    assert by_label["Sim(3)-aligned"].rmse_m <= by_label["SE(3)-aligned (TUM's ATE)"].rmse_m
    assert {row.metric for row in rows} == {"ATE", "RPE"}
    assert all(row.rmse_m is not None and row.pairs > 0 for row in rows)
    short = compare_protocols(noisy(walk(n=20)), walk(n=20))
    missing = next(row for row in short if row.label == "TUM, 1 s, fixed delta")
    assert missing.rmse_m is None
    assert "1 s" in missing.note
