"""What part of which sequence is seen: one identity for every spelling, and for repeats of one problem instance."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from sequence_folders import frame_hash, make_folder

from dynslam_bench.sequences import PreprocessingSettings
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.sequences.synthetic import open_synthetic
from dynslam_bench.sequences.view import Part, part_of

WALK = "synthetic/walking_xyz"


def part(name: object, offset: int = 0, **how: object) -> Part:
    return part_of(open_sequence(str(name), **how), offset)


def test_all_spellings_of_the_same_frames_are_one_part() -> None:
    first = part(f"{WALK}?frames=60")
    spellings = [
        part(WALK, frames="0:60"),
        part(f"{WALK}?scene=0", frames=(0, 60)),
        part(f"{WALK}?scene=000&frames=60"),
        part(f"{WALK}?frames=100", frames=":60"),
        part(f"{WALK}?frames=60", frames="0:90"),
        part(f"{WALK}?frames=60", frames="0:"),
    ]
    assert all(each == first for each in spellings) and first.id == f"{WALK}?scene=0"
    assert part(WALK) == part(f"{WALK}?frames=600")


def test_other_frames_scenes_strides_and_cameras_are_other_problem_instances() -> None:
    others = [
        part(WALK),
        part(WALK, frames="0:60"),
        part(WALK, frames="1:60"),
        part(WALK, frames="0:60", stride=2),
        part(f"{WALK}?scene=1", frames="0:60"),
        part("synthetic/walking_rpy", frames="0:60"),
    ]
    assert len({each.block for each in others}) == len(others)


def test_offset_and_noise_are_repeats_of_one_problem_instance() -> None:
    plain = part(WALK, frames="0:60")
    late = part(WALK, frames="3:60", offset=3)
    noisy = part(f"{WALK}?noise=7", frames="0:60")
    assert plain.block == late.block == noisy.block
    assert part(WALK, frames="3:60").block != plain.block, "without an offset these are other frames"
    assert noisy.content != plain.content and noisy.noise == 7 and noisy.id != plain.id
    assert noisy.content != part(f"{WALK}?noise=8").content


def test_recorded_folders_by_any_path_and_preprocessing(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "a")[0]
    first = part(folder)
    assert part(f"{tmp_path}/./a", frames="0:4") == first
    small = part(folder, preprocessing=PreprocessingSettings(width=24, height=18))
    assert small.block == first.block, "preprocessing is a tracker's setting, not another recording"
    shutil.copytree(folder, tmp_path / "else" / "a")
    assert part(tmp_path / "else" / "a") == first, "a copy is the same recording"
    camera = (folder / "camera.toml").read_text()
    (tmp_path / "camera.toml").write_text(camera.replace("fx = 30.0", "fx = 31.0"))
    assert part(folder, camera=tmp_path / "camera.toml").block != first.block
    other = make_folder(tmp_path / "b" / "a", start=200.0)[0]
    assert part(other).block != first.block, "another recording in a folder of the same name is not"


def test_a_noise_seed_changes_the_noise_and_nothing_else(tmp_path: Path) -> None:
    ids = [f"{WALK}?scene=3&frames=2{noise}" for noise in ("", "&noise=1", "&noise=2")]
    plain, one, two = (open_synthetic(name, tmp_path) for name in ids)
    assert frame_hash(plain[1])[:16] == "8ed2db9ef4f896d1", "scenes keep their bytes"
    assert len({frame_hash(each[1]) for each in (plain, one, two)}) == 3
    assert frame_hash(one[1]) == frame_hash(open_synthetic(f"{WALK}?scene=3&frames=2&noise=1", None)[1])
    assert frame_hash(one[1]) == frame_hash(one[1]), "read back from a folder of its own"
    assert np.array_equal(plain.exact_depth(1), one.exact_depth(1))
    assert np.array_equal(plain.masks[1].instances, one.masks[1].instances)
    assert np.array_equal(plain.ground_truth.T_world_cam, one.ground_truth.T_world_cam)
    difference = np.abs(plain[1].rgb.astype(int) - one[1].rgb.astype(int))
    assert 0.3 < difference.mean() < 5 and difference.max() < 40, "grey levels: noise, no other picture"
