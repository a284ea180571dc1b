"""Splits that are not apart are refused however they are spelled; scenes that a network was trained on are marked."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import pytest
import simulated
import toy_tracker

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.settings import apply_overrides
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.sequences.view import part_of
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.tuning import Study, StudySpec, Verdict, finish, run_study, write_page
from dynslam_bench.tuning.page import warnings_of
from dynslam_bench.tuning.splits import check_splits, seen_note, splits_seen
from dynslam_bench.tuning.storage import errors_of

TRACKER = f"{toy_tracker.__file__}:SPEC"
WALK = "synthetic/walking_xyz"


def spec(tune: list[str], held_out: list[str], **changes: object) -> StudySpec:
    values: dict[str, object] = {
        "name": "toy", "tracker": TRACKER, "tune": tune, "held_out": held_out, "trials": 2, "top": 1,
        "space": {"include": ["gain"]}, "pruner": "none", "min_coverage": None, "offsets": [0], "recorded": [],
    }  # fmt: skip
    return StudySpec.model_validate({**values, **changes})


def faults(tune: list[str], held_out: list[str], *, accept: bool = False) -> list[str]:
    study = spec(tune, held_out)
    splits = {"tune": study.instances(*study.tune), "held_out": study.instances(*study.held_out)}
    return check_splits(study.name, splits, accept=accept)


@pytest.mark.parametrize("other", ["?scene=0", "?scene=000", "@0", "?scene=0&frames=50", "?frames=10&noise=3", ""])
def test_rendered_sequences_overlap_in_every_spelling(other: str) -> None:
    with pytest.raises(StudyError, match=r"^[^\n]*are the same sequence") as caught:
        faults([WALK], [f"{WALK}{other}"])
    assert f"'{WALK}'" in str(caught.value), "both spellings"


def test_a_path_is_a_spelling_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    toy_tracker.make_sequence(tmp_path / "toys" / "a", 0.3)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(StudyError, match="are the same sequence"):
        faults(["./toys/a"], [str(tmp_path / "toys" / ".." / "toys" / "a")])


def test_a_copy_is_the_same_recording(tmp_path: Path) -> None:
    whole = str(toy_tracker.make_sequence(tmp_path / "whole", 0.3))
    copy = str(shutil.copytree(whole, tmp_path / "copy"))
    for tune, held_out, named in (
        ([whole], [copy], "are the same sequence"),
        ([whole, copy], [], "are the same frames"),
    ):
        with pytest.raises(StudyError, match=named) as caught:
            faults(tune, held_out)
        assert whole in str(caught.value) and copy in str(caught.value)


def disguised(whole: Path, copy: Path, how: str) -> Path:
    """A copy of a toy recording: renamed, shifted, re-encoded, beginning later, seen from elsewhere, or all of it."""
    shutil.copytree(whole, copy)
    shift = 0.001 if how in ("shifted", "all") else 0.0
    names = {f"{i}.png": f"{100 + i}-b.png" if how in ("renamed", "all") else f"{i}.png" for i in range(24)}
    dropped = 5 if how in ("later", "all") else 0
    for kind in ("rgb", "depth"):
        for old, new in names.items():
            image = cv2.imread(str(copy / kind / old), cv2.IMREAD_UNCHANGED)
            (copy / kind / old).unlink()
            level = 0 if how in ("re-encoded", "all") else 3
            cv2.imwrite(str(copy / kind / new), image, [cv2.IMWRITE_PNG_COMPRESSION, level])
    for kind in ("rgb", "depth", "groundtruth"):
        lines = [line.split() for line in (copy / f"{kind}.txt").read_text().splitlines()[dropped:]]
        for words in lines:
            words[0] = f"{float(words[0]) + shift:.6f}"
            if kind != "groundtruth":
                words[1] = f"{kind}/{names[Path(words[1]).name]}"
            elif how in ("elsewhere", "all"):  # turned by 90 degrees and moved
                words[1:4] = ["5", f"{float(words[1]) - 2:.6f}", "1"]
        (copy / f"{kind}.txt").write_text("\n".join(" ".join(words) for words in lines) + "\n")
    return copy


@pytest.mark.parametrize("how", ["renamed", "shifted", "re-encoded", "later", "elsewhere", "all"])
def test_a_copy_in_disguise_is_the_same_recording(tmp_path: Path, how: str) -> None:
    whole = toy_tracker.make_sequence(tmp_path / "whole", 0.3, 24)
    copy, disguised_copy = (disguised(whole, tmp_path / name, how) for name in ("copy", "twin"))
    assert part_of(open_sequence(str(copy))).scene != part_of(open_sequence(str(whole))).scene, "digests alone pass it"
    with pytest.raises(StudyError, match="are the same sequence"):
        faults([str(whole)], [str(copy)])
    with pytest.raises(StudyError, match="are the same sequence"):
        faults([str(disguised_copy)], [str(whole)])
    for phase in (0.9, 1.7, 2.5):
        other = toy_tracker.make_sequence(tmp_path / f"other{phase}", phase, 24)
        assert faults([str(copy)], [str(other)]) == []


@pytest.mark.parametrize(
    ("tune", "held_out", "named"),
    [
        (["?scene=1"], ["?scene=5"], r"scene=5' is used as held-out.*0-99.*the tune split"),
        (["?scene=105"], ["?scene=101"], r"scene=105' is used as tune.*100-199.*held-out split"),
    ],
)
def test_scenes_stay_in_their_split(tune: list[str], held_out: list[str], named: str) -> None:
    splits = [[f"{WALK}{query}" for query in queries] for queries in (tune, held_out)]
    with pytest.raises(StudyError, match=named):
        faults(*splits)
    assert len(faults(*splits, accept=True)) == 1
    assert faults([f"{WALK}?scene=1", f"{WALK}?scene=1&noise=4"], [f"{WALK}?scene=101"]) == []


def test_the_catalogues_split_is_enforced(tmp_path: Path) -> None:
    held, tune, plain = (
        str(toy_tracker.make_sequence(tmp_path / name, phase))
        for name, phase in (
            ("rgbd_dataset_freiburg3_walking_rpy", 3.4), ("rgbd_dataset_freiburg3_walking_xyz", 3.9), ("plain", 0.7)
        )
    )  # fmt: skip
    with pytest.raises(StudyError, match="the catalogue puts it into the held-out"):
        faults([held], [])
    with pytest.raises(StudyError, match="the catalogue puts it into the tune"):
        faults([plain], [tune])
    assert faults([tune], [held]) == []


def test_an_accepted_overlap_stands_in_every_table(tmp_path: Path) -> None:
    whole = toy_tracker.make_sequence(tmp_path / "whole", 0.3)
    copy = shutil.copytree(whole, tmp_path / "copy")
    with pytest.raises(StudyError, match="allow_overlap = true"):
        Study(spec([str(whole)], [str(copy)]), tmp_path / "results")
    tuner = run_study(spec([str(whole)], [str(copy)], allow_overlap=True), results=tmp_path / "results")
    summary = finish(tuner)
    assert len(summary.split_notes) == 1 and summary.verdict != Verdict.PROVEN
    for text in (summary.conclusion, (tuner.folder / "best.toml").read_text(), write_page(tuner, summary).read_text()):
        assert "SPLITS ARE NOT APART" in " ".join(text.replace("#", " ").split())
    assert (tuner.folder / "index.html").read_text().count("The splits are NOT apart") >= 2, "below each table"


def test_a_tracker_without_randomness_has_repeats_that_differ(tmp_path: Path) -> None:
    folder = str(toy_tracker.make_sequence(tmp_path / "a", 0.3))
    fixed = {"include": ["gain"], "fixed": {"wobble": 0}}
    tuner = run_study(spec([folder], [], seeds=[0, 1], offsets=[0, 2], space=fixed), results=tmp_path / "results")
    errors = errors_of(tuner.study.get_trials()[1])
    assert sorted((instance.seed, instance.offset) for instance in errors) == [(0, 0), (0, 2), (1, 0), (1, 2)]
    by_start = [{ate for instance, ate in errors.items() if instance.offset == start} for start in (0, 2)]
    assert all(len(values) == 1 for values in by_start) and by_start[0] != by_start[1]
    assert any("seeds" in note for note in warnings_of(tuner))


@pytest.mark.parametrize(
    ("source", "seen"), [("auto", ["tune", "confirm"]), ("embedded", ["tune", "confirm"]), ("oracle", [])]
)
def test_the_embedded_network_alone_was_trained_on_the_scenes(source: str, seen: list[str]) -> None:
    study = simulated.make_spec()
    design = simulated.simulated_design(study)
    settings = apply_overrides(TRACKERS.get("mask-rcnn").settings(), {"segmentation.source": source})
    assert splits_seen(settings, design) == seen
    assert splits_seen(TRACKERS.get(TRACKER).settings(), design) == [], "a system without masks"


@pytest.mark.parametrize("masks", [True, False])
def test_page_summary_and_preset_mark_scenes_of_the_training(masks: bool, tmp_path: Path) -> None:
    changes = {"tracker": "mask-rcnn", "space": {"include": ["features.n_features"]}} if masks else {}
    tuner = simulated.SimulatedTuner(simulated.make_spec(trials=3, **changes), tmp_path)
    tuner.run()
    summary = finish(tuner)
    assert summary.seen == (["tune", "confirm"] if masks else []) and bool(seen_note(summary.seen)) == masks
    page, preset = write_page(tuner, summary).read_text(), (tuner.folder / "best.toml").read_text()
    assert ("in the trial §" in page, "unseen instances §" in page, "held-out §" in page) == (masks, masks, False)
    assert page.count("trained on those very scenes") >= 3 * masks and ("trained on" in preset) == masks
