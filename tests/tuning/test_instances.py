"""Problem instances: what a study file names, what is refused, and which instances a study takes for what."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
import toy_tracker

from dynslam_bench.core.errors import DynslamError, StudyError
from dynslam_bench.tuning.splits import check_splits, design_of, with_more_starts
from dynslam_bench.tuning.study_file import ProblemInstance, StudySpec, further_scenes, parse_instances, scenes

WALK = "synthetic/walking_xyz"


def test_a_text_names_scenes_lengths_and_starts() -> None:
    instances = parse_instances(f"{WALK}?scene=0-1,7&frames=80&offsets=0-4")
    assert len(instances) == 15
    assert instances[0] == ProblemInstance(f"{WALK}?scene=0&frames=80")
    assert instances[-1] == ProblemInstance(f"{WALK}?scene=7&frames=80", offset=4)
    assert list(scenes(instances)) == [f"{WALK}?scene=0", f"{WALK}?scene=1", f"{WALK}?scene=7"]


@pytest.mark.parametrize("text", [
    "bonn/crowd[0:120]", "bonn/crowd[40:]?offsets=2,5&stride=2", "bonn/crowd?frames=120&degrade=blur:0.5,glare:0.2",
    f"{WALK}[10:40]?scene=3&frames=60&noise=7&seeds=0-1", "tum/fr1/xyz", "some/folder[0:9]?offsets=1",
])  # fmt: skip
def test_the_text_of_an_instance_names_it(text: str) -> None:
    instances = parse_instances(text)
    assert [parse_instances(str(instance)) for instance in instances] == [(instance,) for instance in instances] != []


def test_parts_strides_and_degradation_reach_the_run() -> None:
    (instance,) = parse_instances("bonn/crowd[20:120]?offsets=3&stride=2&degrade=blur:0.5&seeds=4")
    run = instance.run_spec("orb-slam2", threads=2)
    assert (run.frames, run.offset, run.stride, run.seed, run.threads) == ((20, 120), 3, 2, 4, 2)
    assert run.degrade == {"blur": 0.5}
    assert parse_instances("bonn/crowd?frames=120")[0].frames == (0, 120)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("bonn/crowd[0:10", "names no instances"),
        ("bonn/crowd[9:3]", "9:3"),
        (f"{WALK}?scene=5-2", "'5-2'"),
        (f"{WALK}?scene=1,0-2", "'0-2'"),
        (f"{WALK}?scene=first", "'scene=first'"),
        ("bonn/crowd?offset=3", "'offset=3'.*offsets"),
        ("bonn/crowd?stride=2&stride=3", "stride twice"),
        ("bonn/crowd?noise=3", "noise"),
        ("bonn/crowd?scene=3", "scene"),
        ("bonn/crowd[0:9]?frames=3", "frames"),
        ("bonn/crowd?degrade=blurr:0.3", "'blurr'.*'blur'"),
        ("bonn/crowd?degrade=blur:3", "'blur' is 3.0"),
        ("bonn/crowd?degrade=blur:much", "blur:much"),
    ],
)
def test_what_cannot_be_read_is_one_clear_line(text: str, named: str) -> None:
    with pytest.raises(DynslamError, match=named) as caught:
        parse_instances(text)
    assert "\n" not in str(caught.value)


@pytest.fixture
def folder(tmp_path: Path) -> str:
    return str(toy_tracker.make_sequence(tmp_path / "a", 0.3))


def test_instances_are_measured_against_their_sequence(folder: str) -> None:
    assert len(ProblemInstance(folder, (2, 10), offset=1, stride=3).open()) == 3
    for instance, named in (
        (ProblemInstance(folder, (0, 20)), r"0 to 19.* 12 frames"),
        (ProblemInstance(folder, offset=11), "1 frames, it needs 2"),
    ):
        with pytest.raises(StudyError, match=named):
            instance.open()
    (Path(folder) / "groundtruth.txt").unlink()
    with pytest.raises(StudyError, match="no ground truth"):
        ProblemInstance(folder).open()


def test_instances_of_one_recording_are_apart_or_repeats(folder: str) -> None:
    one, later = ProblemInstance(folder, (0, 6)), ProblemInstance(folder, (6, 12))
    check_splits("s", {"tune": [one, replace(one, offset=1), later]})
    for instances, named in (
        ([one, ProblemInstance(folder, (4, 12))], "share 2 frames"),
        ([one, one], "is named twice"),
        ([ProblemInstance(folder), ProblemInstance(folder, (0, 12))], "are the same frames"),
    ):
        with pytest.raises(StudyError, match=named):
            check_splits("s", {"tune": instances})
    with pytest.raises(StudyError, match=f"{re.escape(folder)}' held out are the same sequence"):
        check_splits("s", {"tune": [one], "held_out": [later]})


def test_the_baseline_runs_from_three_starts() -> None:
    few = parse_instances(f"{WALK}?scene=0-3&frames=20&offsets=0,3")
    first = [instance.offset for instance in with_more_starts(few) if instance.scene.endswith("?scene=0")]
    assert sorted(first) == [0, 1, 3]


@pytest.mark.parametrize(("scenes_to_tune_on", "reserved"), [(1, 18), (11, 18), (40, 20)])
def test_the_choice_is_made_on_further_scenes(scenes_to_tune_on: int, reserved: int) -> None:
    spec = StudySpec(name="s", tune=(f"{WALK}?scene=0-{scenes_to_tune_on - 1}&frames=20",), recorded=())
    design = design_of(spec)
    confirm, tune = ({instance.scene for instance in split} for split in (design.confirm, design.tune))
    assert (len(tune), len(confirm)) == (scenes_to_tune_on, reserved) and not confirm & tune
    assert len({instance.scene for instance in design.tune[:scenes_to_tune_on]}) == scenes_to_tune_on, "in turn"
    assert {instance.offset for instance in design.confirm} == {0, 3}


def test_further_scenes_are_of_all_sequences_in_turn_and_of_their_split() -> None:
    tune = (f"{WALK}?scene=0-1&frames=20&offsets=0", "synthetic/sitting_xyz?scene=5&frames=20&offsets=2&seeds=3")
    spec = StudySpec(name="s", tune=tune, confirm=(tune[0].replace("0-1", "7"),), recorded=(),
                     held_out=(f"{WALK}?scene=100-101&frames=20&offsets=0",))  # fmt: skip
    design = design_of(spec, further=2)
    assert [instance.scene.rpartition("=")[2] for instance in design.confirm] == ["7", "2", "3"]
    assert [instance.scene.rpartition("=")[2] for instance in design.held_out] == ["100", "101", "102", "103"]
    added = further_scenes(spec.instances(*tune), 2, set(), range(3, 9))
    assert [str(instance) for instance in added] == [
        f"{WALK}?scene=3&frames=20&offsets=0", "synthetic/sitting_xyz?scene=3&frames=20&offsets=2&seeds=3"
    ]  # fmt: skip
    with pytest.raises(StudyError, match=r"2 further scenes.*only 1"):
        further_scenes(spec.instances(tune[0]), 2, {f"{WALK}?scene=3"}, range(3, 5))


def test_recordings_are_confirmed_on_other_stretches_or_not_at_all(folder: str) -> None:
    def confirm(*tune: str, **changes: object) -> list[str]:
        spec = StudySpec.model_validate({"name": "s", "tune": tune, "recorded": (), "offsets": (0,), **changes})
        return [str(instance).removeprefix(folder) for instance in design_of(spec).confirm]

    assert confirm(f"{folder}[0:3]", f"{folder}[3:5]") == ["[5:8]?offsets=0", "[8:10]?offsets=0"]
    assert confirm(f"{folder}[0:8]") == [] == confirm(folder), "no frames are left"
    for other in (f"{folder}[2:6]", f"{folder}[0:4]?offsets=1"):
        with pytest.raises(StudyError, match=r"share [24] frames"):
            confirm(f"{folder}[0:4]", confirm=(other,))


def test_a_recording_that_is_here_is_in_the_check(folder: str, tmp_path: Path) -> None:
    root = tmp_path / "data"
    toy_tracker.make_sequence(root / "bonn" / "rgbd_bonn_crowd", 0.2)
    recorded = design_of(StudySpec(name="s", tune=(folder,), data_root=str(root))).recorded
    assert recorded == tuple(ProblemInstance("bonn/crowd", recorded[0].frames, offset) for offset in range(4))
    assert design_of(StudySpec(name="s", tune=(folder,), recorded=(), data_root=str(root))).recorded == ()
    assert design_of(StudySpec(name="s", tune=(folder,), data_root=str(tmp_path / "empty"))).recorded == ()
