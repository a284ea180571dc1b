"""Readers of text that people and other programs write: trajectories, lists, settings, labels, answers, addresses."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from dynslam_bench.cli.output import cell_text  # how a cell of a table is written
from dynslam_bench.core import download as address
from dynslam_bench.core import sanitise as harmless
from dynslam_bench.core import settings as core_settings
from dynslam_bench.core import toml
from dynslam_bench.core.errors import DynslamError, TrackerError
from dynslam_bench.core.reading import compare_sums
from dynslam_bench.geometry import trajectory_files
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.runs import bank
from dynslam_bench.segmentation import recorded
from dynslam_bench.segmentation.training import labelled_images as labels
from dynslam_bench.sequences import cameras, catalogue, fetch
from dynslam_bench.sequences.readers import layouts, lists
from dynslam_bench.sequences.readers import recorded as recorded_sequence
from dynslam_bench.sequences.synthetic import parse_synthetic_id
from dynslam_bench.slam.settings import TrackingSettings
from dynslam_bench.suites import load_suite
from dynslam_bench.trackers.adapters import subprocess_tracker as answers
from dynslam_bench.tuning import study_file

from .campaign import Target, at
from .mutate import mutate_json
from .records import FIXTURE

ROOT = Path(__file__).resolve().parents[2]
POSES = (
    b"# a comment\n1.0 0 0 0 0 0 0 1\n3.0,1,2,3,0,0,0,2\n2.0\t1 2 3 0 0 0.6 0.8\n4.0 nan 0 0 0 0 0 1\n5 0 0 0 0 0 0 0\n"
)
LIST = (
    b"# timestamp filename\n1.000000 rgb/1.png\n2.000000 rgb/2.png\n1.5 rgb/3.png\n2.0 rgb/4.png\nnan rgb/5.png\n3.0\n"
)
PAIRS = b"1.0 rgb/1.png 1.01 depth/1.png\n2.0 rgb/2.png 2.01 depth/2.png\n1.0 rgb/3.png 1.0 depth/3.png\n"
CAMERA = (
    b"width = 640\nheight = 480\nfx = 525.0\nfy = 525.0\ncx = 319.5\ncy = 239.5\n"
    b"distortion = [0.1, 0.0, 0.0, 0.0, 0.0]\nfps = 30.0\n"
)
ANSWER = {"state": "ok", "T_world_cam": np.eye(4).ravel().tolist(), "stats": {"a": 1}, "timings": {"orb": 0.01},
          "trajectory": [[1.0, 0, 0, 0, 0, 0, 0, 1], [2.0, 0, 0, 1, 0, 0, 0, 1]]}  # fmt: skip
COCO = {
    "images": [{"id": 1, "file_name": "a.png"}, {"id": 2, "file_name": "b/c.png"}],
    "categories": [{"id": 1, "name": "person"}],
    "annotations": [
        {"image_id": 1, "category_id": 1, "segmentation": [[1, 1, 6, 1, 6, 6, 1, 6], [0, 0, 1, 1]]},
        {"image_id": 1, "category_id": 1, "segmentation": {"counts": [10, 20, 34], "size": [8, 8]}},
        {"image_id": 1, "category_id": 1, "segmentation": {"counts": ":d0R1", "size": [8, 8]}},
        {"image_id": 1, "category_id": 1, "iscrowd": 1, "segmentation": []},
    ],
}
_DEPTH = cv2.imencode(".png", np.full((8, 8), 5000, np.uint16))[1].tobytes()
_PNG = cv2.imencode(".png", np.full((8, 8, 3), 90, np.uint8))[1].tobytes()


class FewSettings(core_settings.Settings):
    """As large as it takes to have a group: the settings of a whole system take a thousand times as long."""

    tracking: TrackingSettings = TrackingSettings()


def _text_of(data: bytes | None) -> str:
    return (data or b"").decode("utf-8", "surrogateescape")


def _read_sums(data: bytes | None, folder: Path) -> None:
    at(folder, bank.SUMS, data)
    assert all(isinstance(fault, str) for fault in bank.verify(folder))


def _of_text(read: Callable[[str], object]) -> Callable[[bytes | None, Path], object]:
    return lambda data, _: read(_text_of(data))


def _read_kitti(data: bytes | None, folder: Path) -> None:
    trajectory_files.read_kitti(at(folder, "poses.txt", data), at(folder, "times.txt", b"0\n0.1\n"))


def _read_folder(data: bytes | None, folder: Path) -> None:
    """A list names files: none of them may lie outside, whatever it says; pairs and poses are told by their start."""
    if data and data.startswith(PAIRS[:8]):
        at(folder, "associations.txt", data)
    else:
        poses = bool(data) and data.startswith(POSES[:8])
        colour = LIST if poses else data
        at(folder, "groundtruth.txt", data if poses else None)
        at(folder, "rgb.txt", colour)
        at(folder, "depth.txt", None if colour is None else colour.replace(b"rgb/", b"depth/"))
    for name in ("1.png", "3.png", "4.png"):
        at(folder, f"rgb/{name}", _PNG)
        at(folder, f"depth/{name}", _DEPTH)
    camera = Camera(8, 8, 8.0, 8.0, 4.0, 4.0)
    sequence = recorded_sequence.RecordedSequence(folder, layouts.read_tum(folder, 30.0), camera, id="fuzz")
    files = (*sequence._colour, *sequence._depth)
    assert files and all((folder / file).resolve().is_relative_to(folder.resolve()) for file in files)


def _read_manifest(data: bytes | None, folder: Path) -> None:
    at(folder, "rgb/1.png", _PNG)
    compare_sums(folder, at(folder, fetch.MANIFEST, data))


def _read_coco(data: bytes | None, folder: Path) -> None:
    at(folder, "a.png", _PNG)
    at(folder, "b/c.png", _PNG)
    images = labels.coco_images(at(folder, "annotations.json", data))
    assert images.name and images.version
    for index in range(min(len(images), 4)):
        images[index]


def _read_yolo(data: bytes | None, folder: Path) -> None:
    at(folder, "images/a.png", _PNG)
    at(folder, "labels/a.txt", data)
    images = labels.yolo_images(folder)
    assert images.name and images.version and len(images) == 1
    images[0]


def _read_answer(text: str) -> None:
    answer = answers.parse_answer(text)
    try:
        answers.read_track_answer(answer, "program at frame 1", lambda: 0.1)
    except TrackerError:
        answers.read_final_answer(answer, "program at finalize")
    else:
        answers.read_final_answer(answer, "program at finalize")


def _override(text: str) -> None:
    assigned = core_settings.parse_assignments(text.split("\n"))
    core_settings.apply_overrides(FewSettings(), assigned)


def _read_settings(data: bytes | None, folder: Path) -> None:
    core_settings.apply_overrides(FewSettings(), toml.read_settings(at(folder, "s.toml", data)))


def _harmless(text: str) -> None:
    """Whatever a record says, the terminal gets no escape, the file no half character, the path no way out."""
    assert not set(harmless.printable(text)) & {chr(code) for code in (*range(9), *range(14, 32), 0x9B, 0x202E)}
    str(harmless.storable({text: [text]})).encode()
    assert "\n" not in cell_text(text)
    if harmless.is_inside(text):
        assert (Path("/root/x") / text).resolve().is_relative_to("/root/x")


def _study_texts() -> list[bytes]:
    """Studies; one with an unknown key, one of the old form, one whose sequence can be no path."""
    small = (FIXTURE.parent / "small.toml").read_bytes()
    far = b'tracker = "never-move"\ntune = ["/' + b"a" * 5000 + b'"]\n'
    return [small, (ROOT / "docs/studies/thresholds.toml").read_bytes(), b"bogus = 1\n" + small, far,
            b'pruner = "median"\nobjectives = ["ate", "speed"]\n' + far]  # fmt: skip


def _ids(text: str) -> None:
    for read in (parse_synthetic_id, catalogue.parse_frames, catalogue.entry_of):
        try:
            read(text)
        except DynslamError:
            continue


TARGETS = [
    Target(
        "TUM trajectory",
        lambda data, folder: trajectory_files.load_tum(at(folder, "poses.txt", data)),
        lambda: [
            POSES,
            b"1 2 3\n",
            b"1 2 3 4 5 6 7 8 9 0 1 2\n",
            b"1 rgb/1.png\n",
            b"1 2 3 4 5 6 7 x\n",
            b"# nothing\n",
            b"1 nan 0 0 0 0 0 1\n2 0 0 0 0 0 0 0\n",
        ],
    ),
    Target(
        "KITTI trajectory",
        _read_kitti,
        lambda: [
            *(b"1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1 0 1 0 2 0 0 1 3" + b"\n" * ends for ends in (1, 2)),
            *(b"# none\n\n", b"1 0 0 0 0 1 0 0 0 0 1 x\n", b"1 2 3\n", b"2 0 0 0 0 2 0 0 0 0 2 0\n"),
        ],
    ),
    Target("list of images", lambda data, folder: lists.read_image_list(at(folder, "rgb.txt", data)), lambda: [LIST]),
    Target("associations", lambda data, folder: lists.read_associations(at(folder, "a.txt", data)), lambda: [PAIRS]),
    Target(
        "folder in TUM layout",
        _read_folder,
        lambda: [LIST, LIST.replace(b"rgb/2", b"../2"), PAIRS, POSES, PAIRS.replace(b"rgb/2", b"../2")],
    ),
    Target("manifest of a fetch", _read_manifest, lambda: [b"0" * 64 + b"  rgb/1.png\n" + b"1" * 64 + b"  gone.png\n"]),
    Target("checksums of a bank", _read_sums, lambda: [b"0" * 64 + b"  runs/x\n" + b"1" * 64 + b"  ../gone\n", b"x\n"]),
    Target(
        "manifest of a bank",
        lambda data, folder: bank.read_manifest(at(folder, "m.toml", data)),
        lambda: [(ROOT / "docs/how-to/authors.toml").read_bytes()[:3000], b"trajectory = [1]\n", b"[[trajectory]]\n"],
    ),
    Target(
        "camera",
        lambda data, folder: cameras.read_camera(at(folder, "camera.toml", data)).camera(),
        lambda: [CAMERA, b'name = "tum-fr1"\n', b'name = "x"\n', b"width = 640\n", b"fps = " + b"[" * 5000],
    ),
    Target(
        "settings file",
        _read_settings,
        lambda: [
            b"[settings]\n[settings.tracking]\nradius_px = 15\n",
            *(b"a.b = 1\n", b"settings = 3\n", b'tracking.radius_px = "' + b"a" * 300 + b'"\n'),
            *(b"tracking.radius_px = 0x" + b"f" * 5000 + b"\n",),
        ],
    ),
    Target(
        "--set",
        _of_text(_override),
        lambda: [
            b"tracking.radius_px=15\ntracking.local_map=all",
            *(b"x=1", b"tracking=1", b"tracking.radius_px.x=1", b"a.b.c=1", b"tracking.x=1"),
            *(b"tracking.radius_px=[1]", b"tracking.radius_px=" + b"9" * 4999, b"tracking.radius_px"),
        ],
    ),
    Target(
        "suite",
        lambda data, folder: load_suite(at(folder, "s.toml", data)),
        lambda: [
            (ROOT / "dynslam_bench/suites/smoke.toml").read_bytes(),
            b'trackers = ["never-move"]\nsequences = ["a"]\nsedes = [1]\n',
            b"trackers = 3\n",
        ],
    ),
    Target("study", lambda data, folder: study_file.read_study(at(folder, "s.toml", data)), _study_texts),
    Target(
        "COCO annotations",
        _read_coco,
        lambda: [
            json.dumps(COCO).encode(),
            b'{"images": [], "annotations": [], "categories": []}',
            *(
                json.dumps(COCO | {"annotations": [{**COCO["annotations"][0], "segmentation": odd}]}).encode()
                for odd in (
                    [[1, 2, 1000000000.0, 3, 4, 5]],
                    {"counts": "a", "size": [8, 8]},
                    {"size": 3},
                    "x",
                    {"counts": [64], "size": [8, 8]},
                    {"counts": [1], "size": [8, 8]},
                    [[1, 2]],
                )
            ),
        ],
        mutate_json,
    ),
    Target(
        "YOLO labels",
        _read_yolo,
        lambda: [b"0 0.1 0.1 0.9 0.1 0.9 0.9\n56 0 0 1 0 1 1\n\n", b"-1 0 0\n", b"0 nan 0\n", b"0 0 0\n"],
    ),
    Target(
        "classes of recorded masks",
        lambda data, folder: recorded.read_classes(at(folder, "classes.json", data)),
        lambda: [b'{"1": "person", "7": "chair"}'],
        mutate_json,
    ),
    Target(
        "answers of a program",
        _of_text(_read_answer),
        lambda: [
            json.dumps(ANSWER | odd).encode()
            for odd in (
                {},
                {"state": "lost", "T_world_cam": None},
                {"T_world_cam": None},
                {"T_world_cam": [2] * 16},
                {"trajectory": [[1, 0, 0, 0, 0, 0, 0, 9]]},
                {"trajectory": [[1, 0, 0, 0, 0, 0, 0, 1]] * 2},
                *({"trajectory": "x"}, {"T_world_cam": "x"}, {"stats": []}, {"state": 3}, {"dynamic_mask": "x"}),
            )
        ],
        mutate_json,
    ),
    Target(
        "web address",
        lambda data, _: address.check_address(_text_of(data), checked=False),
        lambda: [
            b"https://cvg.cit.tum.de/rgbd/x.tgz",
            b"https://[::1]:8080/x?y=z",
            b"http://127.0.0.1:80/x.tgz",
            b"http://host/x",
            b"https://a:b@host/x",
            b"https:///x",
            b"ftp://host/x",
            b"https://[x/y",
        ],
    ),
    Target("names and texts", _of_text(_harmless), lambda: [b"rgb/1.png", "Zoë \x1b[2J\u202e".encode()]),
    Target(
        "ids of sequences",
        _of_text(_ids),
        lambda: [
            b"synthetic/walking_xyz?scene=3&frames=60&noise=2",
            b"3:60",
            b"3:2",
            b"x:",
            b"synthetic/walking_xyz?x=1",
            b"synthetic/walking_xyz?frames=1&frames=2",
            b"synthetic/walking_xyz?frames=0",
            b"synthetic/x",
        ],
    ),
]
