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
from dynslam_bench.tuning import StudySpec, finish, write_page
from dynslam_bench.tuning.splits import check_splits, seen_note, splits_seen

TRACKER = f"{toy_tracker.__file__}:SPEC"
WALK = "synthetic/walking_xyz"


def spec(tune: list[str], held_out: list[str], **changes: object) -> StudySpec:
    values: dict[str, object] = {
        "name": "toy", "tracker": TRACKER, "tune": tune, "held_out": held_out, "trials": 2, "top": 1,
        "space": {"include": ["gain"]}, "pruner": "none", "min_coverage": None, "offsets": [0], "recorded": [],
    }  # fmt: skip
    return StudySpec.model_validate({**values, **changes})


def check(tune: list[str], held_out: list[str]) -> None:
    study = spec(tune, held_out)
    check_splits(study.name, {"tune": study.instances(*study.tune), "held_out": study.instances(*study.held_out)})


@pytest.mark.parametrize("other", ["?scene=0", "?scene=000", "@0", "?scene=0&frames=50", "?frames=10&noise=3", ""])
def test_rendered_sequences_overlap_in_every_spelling(other: str) -> None:
    with pytest.raises(StudyError, match=r"^[^\n]*are the same sequence") as caught:
        check([WALK], [f"{WALK}{other}"])
    assert f"'{WALK}'" in str(caught.value), "both spellings"


def test_a_path_is_a_spelling_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    toy_tracker.make_sequence(tmp_path / "toys" / "a", 0.3)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(StudyError, match="are the same sequence"):
        check(["./toys/a"], [str(tmp_path / "toys" / ".." / "toys" / "a")])


def test_a_copy_is_the_same_recording(tmp_path: Path) -> None:
    whole = str(toy_tracker.make_sequence(tmp_path / "whole", 0.3))
    copy = str(shutil.copytree(whole, tmp_path / "copy"))
    for tune, held_out, named in (
        ([whole], [copy], "are the same sequence"),
        ([whole, copy], [], "are the same frames"),
    ):
        with pytest.raises(StudyError, match=named) as caught:
            check(tune, held_out)
        assert whole in str(caught.value) and copy in str(caught.value)


def disguised(whole: Path, copy: Path, how: str) -> Path:
    """A copy of a toy recording: renamed, shifted, re-encoded, beginning later, seen from elsewhere."""
    shutil.copytree(whole, copy)
    shift, dropped = 1000.013 * (how == "shifted"), 5 * (how == "later")
    names = {f"{i}.png": f"{100 + i}-b.png" if how == "renamed" else f"{i}.png" for i in range(24)}
    for kind in ("rgb", "depth"):
        for old, new in names.items():
            image = cv2.imread(str(copy / kind / old), cv2.IMREAD_UNCHANGED)
            (copy / kind / old).unlink()
            cv2.imwrite(str(copy / kind / new), image, [cv2.IMWRITE_PNG_COMPRESSION, 0 if how == "re-encoded" else 3])
    for kind in ("rgb", "depth", "groundtruth"):
        lines = [line.split() for line in (copy / f"{kind}.txt").read_text().splitlines()[dropped:]]
        for words in lines:
            words[0] = f"{float(words[0]) + shift:.6f}"
            if kind != "groundtruth":
                words[1] = f"{kind}/{names[Path(words[1]).name]}"
            elif how == "elsewhere":  # turned by 90 degrees and moved
                words[1:4] = ["5", f"{float(words[1]) - 2:.6f}", "1"]
        (copy / f"{kind}.txt").write_text("\n".join(" ".join(words) for words in lines) + "\n")
    return copy


@pytest.mark.parametrize("how", ["renamed", "shifted", "re-encoded", "later", "elsewhere"])
def test_a_copy_in_disguise_is_the_same_recording(tmp_path: Path, how: str) -> None:
    whole = toy_tracker.make_sequence(tmp_path / "whole", 0.3, 24)
    copy, disguised_copy = (disguised(whole, tmp_path / name, how) for name in ("copy", "twin"))
    assert part_of(open_sequence(str(copy))).scene != part_of(open_sequence(str(whole))).scene, "digests alone pass it"
    with pytest.raises(StudyError, match="are the same sequence"):
        check([str(whole)], [str(copy)])
    with pytest.raises(StudyError, match="are the same sequence"):
        check([str(disguised_copy)], [str(whole)])
    for phase in (0.9, 1.7, 2.5):
        other = toy_tracker.make_sequence(tmp_path / f"other{phase}", phase, 24)
        check([str(copy)], [str(other)])


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
        check(*splits)
    check([f"{WALK}?scene=1", f"{WALK}?scene=1&noise=4"], [f"{WALK}?scene=101"])


def test_the_catalogues_split_is_enforced(tmp_path: Path) -> None:
    held, tune, plain = (
        str(toy_tracker.make_sequence(tmp_path / name, phase))
        for name, phase in (
            ("rgbd_dataset_freiburg3_walking_rpy", 3.4), ("rgbd_dataset_freiburg3_walking_xyz", 3.9), ("plain", 0.7)
        )
    )  # fmt: skip
    with pytest.raises(StudyError, match="the catalogue puts it into the held-out"):
        check([held], [])
    with pytest.raises(StudyError, match="the catalogue puts it into the tune"):
        check([plain], [tune])
    check([tune], [held])


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
