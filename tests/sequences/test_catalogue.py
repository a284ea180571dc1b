"""Finding sequences: ids, aliases, data roots, cameras, plug-ins, and errors that help."""

from collections import Counter

import numpy as np
import pytest
from sequence_folders import make_folder

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.sequences import DATASETS, open_sequence, sequence_ids
from dynslam_bench.sequences.cameras import CAMERAS, read_camera, write_camera
from dynslam_bench.sequences.catalogue import catalogue, entry_of
from dynslam_bench.sequences.fetch import fetch
from dynslam_bench.sequences.synthetic import open_synthetic
from dynslam_bench.sequences.synthetic.settings import RenderSettings
from dynslam_bench.sequences.tags import motion_tags, sequence_tags
from dynslam_bench.sequences.view import SequenceView


@pytest.fixture
def vga(tmp_path):
    """Makes a small sequence of full-size images under a path."""

    def make(path):
        return make_folder(tmp_path / path, frames=2, width=640, height=480)[0]

    return make


def test_the_catalogue_is_complete_and_sound():
    entries = catalogue()
    tum = [entry for entry in entries.values() if entry.dataset == "tum"]
    assert len([entry for entry in tum if entry.ground_truth]) == 47
    assert len([entry for entry in tum if not entry.ground_truth]) == 33
    counts = Counter(entry.dataset for entry in entries.values())
    assert counts == {
        "tum": 80, "bonn": 26, "wild-slam": 10, "eth3d": 55, "icl": 4, "7scenes": 18, "shibuya": 7, "openloris": 22,
    }  # fmt: skip
    for people in ("walking", "sitting"):
        for motion in ("xyz", "static", "halfsphere", "rpy"):
            assert f"tum/fr3/{people}_{motion}" in entries
    for name in ("fr2/pioneer_slam", "fr1/teddy", "fr3/teddy", "fr3/cabinet", "fr1/rpy", "fr1/360_validation"):
        assert f"tum/{name}" in entries
    assert not entries["tum/fr1/360_validation"].ground_truth
    fetched = [entry for entry in entries.values() if not entry.by_hand]
    assert len({entry.url for entry in fetched}) == len(fetched)
    assert len({(entry.dataset, entry.folder) for entry in entries.values()}) == len(entries)
    for key, entry in entries.items():
        assert key == entry.id and entry.tags and entry.license and entry.citation and entry.title
        assert entry.camera in CAMERAS or (entry.camera == "" and entry.layout != "tum")
        assert (entry.split == "") == (not entry.ground_truth)
        assert entry.verified == (entry.dataset in ("tum", "bonn"))
        assert entry.verified or entry.remark.startswith("layout: not verified on the publisher's files")
    assert all(url.startswith("https://") for entry in fetched for url in (entry.url, *entry.more_urls))
    for entry in (entry for entry in fetched if entry.dataset in ("tum", "bonn")):
        assert entry.url.split("/")[-1].split(".")[0] == entry.folder
        assert entry.camera == ("bonn" if entry.dataset == "bonn" else f"tum-{entry.id.split('/')[1]}")


def test_common_folder_names_name_no_sequence(tmp_path):
    """A folder of one's own called crowd is not Wild-SLAM's."""
    folder, *_ = make_folder(tmp_path / "crowd")
    assert open_sequence(folder).id == "folder/crowd" and entry_of("crowd") is None
    assert entry_of("living_room_traj0_frei_png").id == "icl/living_room_0"


def test_what_has_to_be_got_by_hand_says_so(tmp_path):
    with pytest.raises(SequenceError, match=r"is not at .*openloris/market1-1 \(get it by hand from https://lifelong"):
        open_sequence("openloris/market1-1", data_root=tmp_path)
    with pytest.raises(SequenceError, match=r"cannot be fetched by this program: one archive of all sequences"):
        fetch("shibuya/standing01", data_root=tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "place",
    ["tum/rgbd_dataset_freiburg3_walking_xyz", "rgbd_dataset_freiburg3_walking_xyz", "tum/fr3/walking_xyz"],
)
def test_ids_and_aliases_find_a_folder_below_the_root(vga, tmp_path, place):
    vga(place)
    for name in ("tum/fr3/walking_xyz", "rgbd_dataset_freiburg3_walking_xyz"):
        sequence = open_sequence(name, data_root=tmp_path, camera="tum-fr3")
        assert sequence.id == "tum/fr3/walking_xyz" and sequence.camera == CAMERAS["tum-fr3"]
        assert sequence.license == "CC-BY-4.0" and "IROS 2012" in sequence.citation
        assert sequence.tags == {"high-dynamic"} and sequence.split == "tune" and sequence.fps == 30


def test_camera_of_a_published_folder_name(vga):
    folder = vga("anywhere/rgbd_bonn_crowd2")
    (folder / "camera.toml").unlink()
    sequence = open_sequence(folder)
    assert (sequence.id, sequence.camera) == ("bonn/crowd2", CAMERAS["bonn"])


def test_a_missing_sequence_says_all_one_needs(tmp_path):
    with pytest.raises(SequenceError) as caught:
        open_sequence("tum/fr3/walking_xyz", data_root=tmp_path)
    text = str(caught.value)
    for part in (
        "https://cvg.cit.tum.de/rgbd/dataset/freiburg3/rgbd_dataset_freiburg3_walking_xyz.tgz",
        "0.53 GB",
        str(tmp_path / "tum" / "rgbd_dataset_freiburg3_walking_xyz"),
        "dynslam-bench sequences fetch tum/fr3/walking_xyz",
    ):
        assert part in text
    assert "\n" not in text
    with pytest.raises(SequenceError, match="size unknown"):
        open_sequence("tum/fr2/xyz", data_root=tmp_path)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("tum/fr3/walkng_xyz", "did you mean 'tum/fr3/walking_xyz'"),
        ("bonn/crowd9", "did you mean 'bonn/crowd"),
        ("rgbd_dataset_freiburg3_walking_xy", "rgbd_dataset_freiburg3_walking_xyz"),
        ("./nowhere", "there is no sequence folder"),
        ("zzz", "none is close"),
    ],
)
def test_unknown_names(name, words):
    with pytest.raises(SequenceError, match=words):
        open_sequence(name)


def test_camera_file_round_trip(tmp_path):
    camera = Camera(320, 200, 300.1, np.float64(301.2), 159.5, 99.5, (0.1, -0.2, 1e-4, -2e-5, 0.3), 1000.0, 0.05)
    write_camera(tmp_path / "camera.toml", camera, fps=15)
    file = read_camera(tmp_path / "camera.toml")
    assert file.camera() == camera and file.fps == 15


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("fx = ", "not valid TOML"),
        ("width = 640\nheight = 480\nfx = 500.0", "lacks fy, cx, cy"),
        ("name = 'tum-fr9'", "unknown camera 'tum-fr9'.*one of tum-fr1"),
        ("name = 'tum-fr1'\nfocal = 3", "unknown setting 'focal'"),
        ("width = 640\nheight = 480\nfx = -5.0\nfy = 1.0\ncx = 0.0\ncy = 0.0", "'fx' is -5.0"),
        ("width = 640\nheight = 480\nfx = 5.0\nfy = 1.0\ncx = 0.0\ncy = 0.0\ndistortion = [1.0]", "distortion"),
    ],
)
def test_bad_camera_files(tmp_path, text, words):
    folder, *_ = make_folder(tmp_path / "s")
    (folder / "camera.toml").write_text(text)
    with pytest.raises(SequenceError, match=words):
        open_sequence(folder)


def test_camera_choices(tmp_path, vga):
    folder = vga("s")
    assert open_sequence(folder, camera="tum-fr2").camera == CAMERAS["tum-fr2"]
    write_camera(tmp_path / "mine.toml", CAMERAS["bonn"])
    assert open_sequence(folder, camera=tmp_path / "mine.toml").camera == CAMERAS["bonn"]
    (folder / "camera.toml").unlink()
    with pytest.raises(SequenceError, match=r"camera of .* is not known.*--camera tum-fr1\|.*--camera FILE.toml"):
        open_sequence(folder)
    with pytest.raises(SequenceError, match="unknown camera 'tum-f3'"):
        open_sequence(folder, camera="tum-f3")


def test_a_data_set_plugs_in(tmp_path, monkeypatch, vga):
    folder = vga("mine/one")
    plugin = tmp_path / "my_dataset.py"
    plugin.write_text(
        "from dynslam_bench.contracts import DatasetSpec\n"
        "from dynslam_bench.sequences.catalogue import open_folder\n"
        f"SPEC = DatasetSpec('mine', r'{plugin}:load', ('mine/one',))\n"
        "def load(sequence_id, *, data_root):\n"
        "    return open_folder(data_root / sequence_id)\n"
    )
    monkeypatch.setenv("DYNSLAM_BENCH_PLUGINS", f"sequences={plugin}:SPEC,sequences={tmp_path}/broken.py:SPEC")
    DATASETS.refresh()
    try:
        assert "mine/one" in sequence_ids()
        assert len(open_sequence("mine/one", data_root=tmp_path)) == 2
        assert [failure.source for failure in DATASETS.failures()] == [
            f"DYNSLAM_BENCH_PLUGINS: {tmp_path}/broken.py:SPEC"
        ]
    finally:
        monkeypatch.undo()
        DATASETS.refresh()
    assert folder.is_dir()


# Tags: what moves in a scene, and what a camera's path is like.


def path(positions):
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, : positions.shape[1], 3] = positions
    return Trajectory(np.arange(len(positions)) / 30, poses)


@pytest.mark.parametrize(
    ("name", "tags"),
    [
        ("walking_xyz?scene=100", ["high-dynamic"]),
        ("sitting_rpy?scene=100", ["low-dynamic"]),
        ("fast_desk?scene=100", ["fast", "static"]),
        ("loop_room_moved?scene=100", ["loop", "low-dynamic"]),
        ("objects_trolley?scene=100", ["unknown-objects"]),
    ],
)
def test_tags_of_rendered_sequences(name, tags):
    sequence = open_synthetic(f"synthetic/{name}", None)
    assert sequence_tags(sequence) == tags
    assert "loop" not in sequence_tags(SequenceView(sequence, 0, 200)), "the part has not come back yet"


def test_nothing_moves_where_people_are_frozen():
    frozen = RenderSettings(people="frozen")
    sequence = open_synthetic("synthetic/walking_xyz?scene=100&frames=5", None, settings=frozen)
    assert sequence_tags(sequence) == ["static"]


@pytest.mark.parametrize(("radius_m", "turns", "loop"), [(2.5, 1.0, True), (2.5, 0.8, False), (0.9, 4.0, False)])
def test_a_loop_is_a_long_path_that_comes_back_to_where_it_was(radius_m, turns, loop):
    angle = 2 * np.pi * np.linspace(0, turns, 1200)
    circle = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert ("loop" in motion_tags(path(circle))) == loop


def test_noise_of_the_ground_truth_is_no_fast_motion():
    noise = np.random.default_rng(0).normal(0, 0.005, (3000, 3))
    still = path(noise)
    at_300_hz = Trajectory(still.timestamps / 10, still.T_world_cam)
    assert motion_tags(at_300_hz) == set()
    assert motion_tags(path(0.0 * noise)) == {"fixed-camera"}
    straight = path(np.linspace(0, 1.2, 31)[:, None])
    assert motion_tags(straight) == {"fast"}
