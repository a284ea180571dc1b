"""Suites: what comes with the package, and what a user writes."""

from __future__ import annotations

from pathlib import Path

import pytest

from dynslam_bench.core.errors import DynslamError, RunError
from dynslam_bench.runs import RunSpec
from dynslam_bench.sequences.catalogue import entry_of, sequence_ids
from dynslam_bench.sequences.synthetic import parse_synthetic_id
from dynslam_bench.suites import load_suite, suite_names
from dynslam_bench.trackers.registry import TRACKERS


@pytest.mark.parametrize("name", suite_names())
def test_every_suite_names_only_what_exists(name: str) -> None:
    suite = load_suite(name)
    assert suite.title and suite.description and suite.name == name
    for sequence in suite.sequences:
        whole = sequence.partition("?")[0]
        assert whole in sequence_ids() or entry_of(sequence) is not None
        if sequence.startswith("synthetic/"):
            assert parse_synthetic_id(sequence).split == "held-out", "the embedded network was trained on the others"
    specs = suite.specs()
    assert len(specs) == len({spec.model_dump_json() for spec in specs}) > 0


def test_dynamic_holds_every_ranked_system_on_the_eight_replicas() -> None:
    suite = load_suite("dynamic")
    assert len(suite.sequences) == 8 and suite.frames == (0, 200)
    assert suite.seeds == (0,) and suite.offsets == (0, 3), "repeats come from what varies"
    specs = [found.spec for found in TRACKERS.all() if "trackers.systems" in found.spec.entry_point]
    composed = {spec.id for spec in specs if spec.sensors == "rgbd"}
    ablations = {name for name in composed if not TRACKERS.get(name).ranked and name.startswith("emfoa-oft")}
    assert composed - ablations <= set(suite.trackers)
    assert load_suite("dynamic-full").trackers == suite.trackers
    objects = load_suite("objects")
    assert set(suite.trackers) - {"emfoa-oft-paper"} < set(objects.trackers), "its dense flow takes seconds a frame"
    assert objects.settings == {"segmentation.source": "oracle-classes"}


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_a_suite_of_the_users_own(tmp_path: Path) -> None:
    path = write(
        tmp_path / "mine.toml",
        """
        trackers = ["never-move", "orb-slam2"]
        sequences = ["synthetic/walking_xyz"]
        seeds = [0, 1]
        frames = [0, 20]
        [settings]
        "features.count" = 500
        [tracker_settings.orb-slam2]
        "guard.min_features" = 30
        [[variants]]
        [[variants]]
        name = "blur"
        degrade = { blur = 0.5 }
        """,
    )
    specs = load_suite(path).specs(data_root="/data", device="cpu", threads=2)
    assert (
        len(specs) == 8 and {spec.threads for spec in specs} == {2} and {spec.data_root for spec in specs} == {"/data"}
    )
    assert [spec.degrade for spec in specs] == [{}] * 4 + [{"blur": 0.5}] * 4
    orb = next(spec for spec in specs if spec.tracker == "orb-slam2")
    assert orb.settings["guard.min_features"] == 30
    assert all(spec.settings == {} for spec in specs if spec.tracker == "never-move")


def test_offsets_of_a_suite_are_repeats_beside_the_seeds(tmp_path: Path) -> None:
    text = 'trackers = ["never-move"]\nsequences = ["synthetic/walking_xyz"]\nseeds = [0, 1]\noffsets = [0, 3]\n'
    suite = load_suite(write(tmp_path / "mine.toml", text))
    repeats = [(spec.seed, spec.offset) for spec in suite.specs()]
    assert repeats == [(0, 0), (0, 3), (1, 0), (1, 3)]
    assert [spec.offset for spec in suite.specs(seeds=(0,), offsets=(5,))] == [5]
    with pytest.raises(DynslamError, match=r"offsets\.0: input should be greater than or equal to 0"):
        load_suite(write(tmp_path / "bad.toml", text.replace("[0, 3]", "[-1]")))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("trackers = [", "not valid TOML"),
        ('trackers = ["never-move"]', "sequences: field required"),
        ('trackers = []\nsequences = ["a/b"]', "trackers"),
        ('trackers = ["never-mov"]\nsequences = ["a/b"]', "unknown tracker 'never-mov'.*never-move"),
        ('trackers = ["never-move"]\nsequences = ["a/b"]\nseed = [1]', "unknown key 'seed'.*seeds"),
    ],
)
def test_bad_suites(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DynslamError, match=message):
        load_suite(write(tmp_path / "bad.toml", text))


def test_unknown_suites(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"unknown suite 'dynamics'.*dynamic"):
        load_suite("dynamics")
    with pytest.raises(RunError, match="cannot read"):
        load_suite(tmp_path / "none.toml")


def test_frames_of_a_run_are_read_however_they_are_written() -> None:
    ways = [(0, 30), [0, 30], "0:30", ":30"]
    assert {RunSpec(tracker="x", sequence="y", frames=way).frames for way in ways} == {(0, 30)}
    assert {RunSpec(tracker="x", sequence="y", frames=way).frames for way in (None, ":", "0:", (0, None))} == {None}
    with pytest.raises(DynslamError, match=r"5:2"):
        RunSpec(tracker="x", sequence="y", frames="5:2")


def test_rows_are_of_trackers_of_the_suite(tmp_path: Path) -> None:
    text = 'trackers = ["never-move"]\nsequences = ["synthetic/walking_xyz"]\n[[rows]]\ntracker = "{}"\nsettings = {}'
    stranger = write(tmp_path / "a.toml", text.format("orb-slam2", '{ "guard.min_features" = 30 }'))
    with pytest.raises(RunError, match="'orb-slam2', which is none of its trackers"):
        load_suite(stranger).specs()
    with pytest.raises(RunError, match=r"rows\.0\.settings"):
        load_suite(write(tmp_path / "b.toml", text.format("never-move", "{}")))
