"""Rendered frames are the same in every process and come back from the cache as they went in."""

import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from sequence_folders import frame_hash

from dynslam_bench.sequences import SequenceView
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.sequences.synthetic import open_synthetic, render_synthetic
from dynslam_bench.sequences.synthetic.people import draw_person, write_script
from dynslam_bench.sequences.synthetic.rooms import plan_room
from dynslam_bench.sequences.synthetic.sequence import encode_png

DAMAGES = ("cut", "flip", "empty", "other", "gone")


def test_the_first_read_is_what_later_reads_give(tmp_path: Path) -> None:
    sequence = open_synthetic("synthetic/walking_xyz?frames=9", tmp_path, threads=1)
    first = sequence[4]
    assert list(tmp_path.rglob("rgb/*.png"))
    other = pickle.loads(pickle.dumps(sequence))
    again = other[4]
    assert "renderer" not in vars(other), "the second read must not render"
    assert np.array_equal(first.rgb, again.rgb)
    assert np.array_equal(first.depth, again.depth) and again.depth.dtype == np.float32
    assert np.array_equal(sequence.masks[4].instances, sequence.renderer.geometry(4)[1])
    view = SequenceView(sequence, 3)
    assert np.array_equal(view.masks[1].instances, sequence.masks[4].instances) and view[1].index == 1
    assert sequence[-1].index == 8
    with pytest.raises(IndexError):
        sequence[9]


def test_frames_do_not_depend_on_the_length(tmp_path: Path) -> None:
    short, long = (open_synthetic(f"synthetic/walking_rpy?frames={n}", tmp_path, threads=1) for n in (5, 600))
    frame = short[3]
    assert frame_hash(frame) == frame_hash(long[3])
    assert short.store.folder == long.store.folder
    assert np.array_equal(short.ground_truth.T_world_cam, long.ground_truth.T_world_cam[:5])
    assert np.array_equal(short.timestamps, long.timestamps[:5])
    assert short.digest() != long.digest()


def test_ground_truth_and_digest_need_no_rendering(tmp_path: Path) -> None:
    sequence = open_synthetic("synthetic/sitting_static", tmp_path)
    assert len(sequence.ground_truth) == 600
    assert sequence.digest() == open_synthetic("synthetic/sitting_static?scene=0", None).digest()
    assert not list(tmp_path.iterdir())
    assert "renderer" not in vars(sequence)


def test_rendering_goes_on_where_it_stopped(tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []

    def stop_after_three(done: int, total: int) -> None:
        calls.append((done, total))
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_synthetic("synthetic/sitting_xyz?frames=6", tmp_path, threads=1, progress=stop_after_three)
    assert calls[-1] == (3, 6)
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("rgb/*.png")}
    assert len(kept) >= 3
    assert not [path for path in tmp_path.rglob(".*")], "no temporary file may stay"
    folder = render_synthetic("synthetic/sitting_xyz?frames=6", tmp_path, threads=1)
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in kept.items())
    assert len(list((folder / "rgb").glob("*.png"))) == 6
    assert open_synthetic("synthetic/sitting_xyz?frames=6", tmp_path).render() == 0
    masks = [line.split()[1] for line in (folder / "masks.txt").read_text().splitlines() if line[0] != "#"]
    assert len(masks) == 6 and all((folder / file).is_file() for file in masks)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache with a frame for each kind of damage."""
    root = tmp_path_factory.mktemp("rendered")
    open_synthetic(f"synthetic/walking_static?frames={len(DAMAGES)}", root, threads=1).render()
    return root


def spoil(path: Path, damage: str) -> None:
    data = bytearray(path.read_bytes())
    if damage == "gone":
        path.unlink()
        return
    data[len(data) // 2] ^= 0x10
    changed = {"cut": data[: len(data) // 2], "empty": b"", "other": encode_png(np.zeros((4, 4), np.uint8))}
    path.write_bytes(bytes(changed.get(damage, data)))


@pytest.mark.parametrize("kind", ["rgb", "depth", "masks"])
def test_damaged_files_are_rendered_again(tmp_path: Path, rendered: Path, kind: str) -> None:
    root = shutil.copytree(rendered, tmp_path / "cache")
    before, after = (
        open_synthetic(f"synthetic/walking_static?frames={len(DAMAGES)}", each, threads=1) for each in (rendered, root)
    )
    paths = [after.store.path(kind, float(stamp)) for stamp in after.timestamps]
    for path, damage in zip(paths, DAMAGES, strict=True):
        spoil(path, damage)
    for index, damage in enumerate(DAMAGES):
        assert frame_hash(after[index]) == frame_hash(before[index]), damage
        assert np.array_equal(after.masks[index].instances, before.masks[index].instances), damage
    assert "renderer" not in vars(before), "what it is compared with was rendered before the damage"
    assert after.render() == (len(DAMAGES) if kind == "masks" else 0), "masks by themselves are not stored"
    assert all(after.store.bytes_of(kind, float(stamp)) for stamp in after.timestamps)


def test_the_cache_is_a_folder_in_tum_layout(tmp_path: Path) -> None:
    """The folder reader, which knows nothing of rendering, gives the same frames, poses and camera."""
    sequence = open_synthetic("synthetic/walking_halfsphere?frames=3", tmp_path, threads=1)
    sequence.render()
    folder = open_sequence(sequence.store.folder)
    assert len(folder) == 3 and folder.camera == sequence.camera
    for index in range(3):
        assert frame_hash(folder[index]) == frame_hash(sequence[index])
    assert np.abs(folder.ground_truth.T_world_cam - sequence.ground_truth.T_world_cam).max() < 1e-8
    assert np.array_equal(folder.timestamps, sequence.timestamps)


def test_two_processes_may_render_the_same_sequence(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from dynslam_bench.sequences.synthetic import render_synthetic; "
        "render_synthetic('synthetic/walking_static?frames=3', Path(sys.argv[1]), threads=1)"
    )
    children = [subprocess.Popen([sys.executable, "-c", code, str(tmp_path)]) for _ in range(2)]
    assert [child.wait() for child in children] == [0, 0]
    sequence = open_synthetic("synthetic/walking_static?frames=3", tmp_path)
    assert sequence.render() == 0
    assert not [path for path in tmp_path.rglob(".*")]


def test_a_forked_child_can_render_on(tmp_path: Path) -> None:
    code = """
import os, sys
from dynslam_bench.sequences.synthetic import open_synthetic
sequence = open_synthetic("synthetic/walking_xyz", None, threads=2)
before = sequence[3].rgb.tobytes()
child = os.fork()
if child == 0:
    os._exit(0 if sequence[3].rgb.tobytes() == before else 1)
print(os.waitpid(child, 0)[1])
"""
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "0\n"


def test_tuning_and_held_out_scenes_share_nothing() -> None:
    def traits(scene: int) -> set[object]:
        plan, script = plan_room(scene), write_script("walking", scene)
        values: set[object] = {("back", plan.back_y), ("left", plan.left_x), ("desk", plan.desk_y, plan.desk_x)}
        values |= {("path", k, p[0].x, p[0].y) for k, p in enumerate(script.people)}
        values |= {("height", k, draw_person(scene, k).height) for k in range(2)}
        return values

    tune = set().union(*(traits(i) for i in range(0, 100)))
    held_out = set().union(*(traits(i) for i in range(100, 200)))
    assert not tune & held_out
