"""The presets that ship: they fit, change something and act in a run."""

import pandas as pd
import pytest

from dynslam_bench.core.settings import flatten
from dynslam_bench.runs import RunSpec, RunStore, run_many
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.trackers.registry import resolve_settings

SHIPPED = [(found.spec.id, name) for found in TRACKERS.all() for name in found.spec.presets]


@pytest.mark.parametrize(("tracker", "name"), SHIPPED)
def test_each_sets_something_else_than_the_default(tracker, name):
    spec = TRACKERS.get(tracker)
    default, chosen = flatten(spec.settings()), flatten(resolve_settings(spec, spec.presets[name]))
    changed = {key for key in chosen if chosen[key] != default[key]}
    assert changed and changed <= set(spec.presets[name])


@pytest.mark.parametrize(("more", "asked"), [({}, [1, 0, 1, 0, 1, 0, 1]), ({"crowded_share": 0.1}, [1] * 7)])
def test_fast_asks_the_network_on_every_second_frame_but_where_people_cover_the_view(tmp_path, more, asked):
    settings = {"segmentation.source": "oracle", **TRACKERS.get("mask-rcnn").presets["fast"]}
    settings |= {f"segmentation.{name}": value for name, value in more.items()}
    spec = RunSpec(tracker="mask-rcnn", sequence="synthetic/walking_xyz?frames=7", settings=settings)
    (record,) = run_many([spec], results=tmp_path)
    frames = pd.read_csv(RunStore(tmp_path).folder(record.run_id) / "frames.csv")
    assert frames["stat_segmented"].tolist() == asked
