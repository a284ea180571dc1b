"""Readers to attack: what this package stored, texts, images, archives, networks, layouts, formats of other tools."""

import gzip
import io
import json
import lzma
import os
import re
import struct
import tarfile
import tempfile
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import cv2
import numpy as np
from helpers.published_folders import WRITERS, random_poses
from helpers.tflite_files import tflite

from dynslam_bench.cli.output import cell_text  # how a cell of a table is written
from dynslam_bench.contracts import Frame, MapOutputs
from dynslam_bench.core import (
    DynslamError,
    TrackerError,
    compare_sums,
    download,
    images,
    sanitise,
    settings,
    toml,
)
from dynslam_bench.core.stage_cache import StageCache  # what of the cache reads
from dynslam_bench.evaluation import get_protocol
from dynslam_bench.geometry import Camera, load_tum, read_kitti
from dynslam_bench.geometry.motion_covariances import read_motion_covariances
from dynslam_bench.reports.model.load import load_runs
from dynslam_bench.runs import RunRecord, RunStore, artifacts, bank, frames, packing
from dynslam_bench.runs.bank_files import DESCRIPTION_FILE, read_description
from dynslam_bench.runs.exchange import formats, transfer
from dynslam_bench.runs.layout import INDEX_FILE
from dynslam_bench.runs.listing import list_runs
from dynslam_bench.segmentation import recorded
from dynslam_bench.segmentation.networks import onnx_header, onnx_layout, tflite_header
from dynslam_bench.segmentation.training import labelled_images
from dynslam_bench.sequences import cameras, catalogue, fetch
from dynslam_bench.sequences.readers import files, layouts
from dynslam_bench.sequences.readers import recorded as reader
from dynslam_bench.sequences.synthetic import parse_synthetic_id
from dynslam_bench.sequences.synthetic.sequence import FrameStore, encode_png
from dynslam_bench.slam import map_files
from dynslam_bench.slam.atlas import open_atlas, packed
from dynslam_bench.slam.settings import TrackingSettings
from dynslam_bench.suites import load_suite
from dynslam_bench.trackers.adapters import orbslam3, subprocess_tracker
from dynslam_bench.tuning import Study, StudySummary, study_file

from .mutate import mutate, mutate_json, mutate_lines, mutate_png, mutate_zip, zipped

Mutation = Callable[[bytes, Random], bytes]


@dataclass(frozen=True)
class Target:
    """A reader.

    Attributes:
        name: Its name.
        read: Reads what the bytes are in an empty folder of its own; None stands for a file that is
            missing. It ends, or raises an error of `allowed`; anything else is a finding.
        seeds: Makes sound and unsound files, once.
        mutation: Damage that keeps checksums or syntax right, used every other time beside damage
            to plain bytes.
        allowed: The errors that its documentation names.
    """

    name: str
    read: Callable[[bytes | None, Path], object]
    seeds: Callable[[], list[bytes]]
    mutation: Mutation | None = None
    allowed: tuple[type[BaseException], ...] = (DynslamError,)


def written(write: Callable[[io.BytesIO], object]) -> bytes:
    """What a function writes to a file."""
    buffer = io.BytesIO()
    write(buffer)
    return buffer.getvalue()


def at(folder: Path, name: str, data: bytes | None) -> Path:
    """A file of that name with the bytes, or its path where there are none."""
    path = folder / name
    if data is None:
        path.unlink(missing_ok=True)
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return path


FIXTURE = Path(__file__).resolve().parents[1] / "fixtures" / "results"
RUN = "a7abe04996a79cc4"
OTHER = b"e7f8d4df9db4bb16"


@cache
def _stored(name: str) -> bytes:
    (path,) = FIXTURE.glob(name)
    return path.read_bytes()


def _store(folder: Path, run: bytes | None) -> RunStore:
    """A store with one run, all of whose other files are sound."""
    store = RunStore(folder / "results")
    for file in ("trajectory_online.txt", "frames.csv"):
        at(store.runs / RUN, file, _stored(f"runs/{RUN}/{file}"))
    part = store.root / "sequences" / "8a65f345d9b34895"
    for file in ("groundtruth.txt", "timestamps.txt"):
        at(part, file, (FIXTURE / "sequences" / part.name / file).read_bytes())
    at(store.runs / RUN, "run.json", run)
    return store


def _read_run(data: bytes | None, folder: Path) -> None:
    store = _store(folder, data)
    found, unreadable = store.all()
    assert len(found) + len(unreadable) == 1
    record = store.read(RUN)
    record.describe()
    store.score(record)


def _read_index(data: bytes | None, folder: Path) -> None:
    """Whatever the index holds, lists, scores and reports are of the runs that lie there, and of no other."""
    store = _store(folder, _stored(f"runs/{RUN}/run.json"))
    at(store.runs / ("0" * 16), "run.json", b"{")
    for file in store.root.rglob("*.*"):
        os.utime(file, (1, 1))  # values that were computed from another copy hold
    at(store.root, INDEX_FILE, data)
    rows, unreadable = list_runs(store)
    assert [row["run_id"] for row in rows] == [RUN]
    assert len(unreadable) == 1
    assert store.score(store.read(RUN)).run_id == RUN
    loaded = load_runs([store], get_protocol("tum-rgbd/v1"))
    assert [row.run_id for row in loaded.rows] == [RUN]
    assert len(loaded.unreadable) == 1


@cache
def _index() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        _read_index(None, Path(folder))
        return (Path(folder) / "results" / INDEX_FILE).read_bytes()


def _read_part(data: bytes | None, folder: Path) -> None:
    """Stamps and trajectory of a stored run; what is wrong with them is the reason why there are no errors."""
    store = _store(folder, _stored(f"runs/{RUN}/run.json"))
    part = store.root / "sequences" / "8a65f345d9b34895"
    at(part, "timestamps.txt", data)
    if data is None:
        at(part, "groundtruth.txt", None)
    at(store.runs / RUN, "trajectory_final.txt", data)
    store.score(store.read(RUN), again=True)


def _read_log(data: bytes | None, folder: Path) -> None:
    """Whatever a tracker's process left, a run can be stored of it."""
    log = frames.FrameLog.read(at(folder, frames.FRAMES_FILE, data))
    log.write(folder, "comment")
    log.timings(), log.mask_iou(), log.lost_streak(), log.epipolar_skipped()


def _log_seeds() -> list[bytes]:
    made = frames.read_csv(FIXTURE / "runs" / RUN / "frames.csv")
    pose = [0.0, 0.1, 0.2, 0.0, 0.0, 0.0, 1.0]
    lines = [json.dumps({**vars(row), "pose": pose}) + "\n" for row in made]
    odd = (
        {"pose": pose[:6]},
        {"stats": {"a": "x"}},
        {"state": "asleep"},
        {"timestamp": "nan"},
        {"x": 1},
    )
    one = json.loads(lines[0])
    return [
        *(
            "".join(lines).encode(),
            lines[0].encode(),
            "".join(lines).encode()[:-30],
            lines[0].encode() * 2,
            b"[]\n",
        ),
        *(json.dumps(one | each).encode() + b"\n" for each in odd),
    ]


def _packed_seeds() -> list[bytes]:
    store = RunStore(FIXTURE)
    packed = packing.pack(store, store.read(RUN))
    lying = bytearray(packed)
    start = lying.index(b"PK\x01\x02") + 24  # the size that the first file claims
    lying[start : start + 4] = b"\xfe\xff\xff\xff"
    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    renamed = [
        {name.replace(RUN, run): content for name, content in files.items()}
        for run in ("0" * 16, "zz")
    ]
    return [
        packed,
        bytes(lying),
        zipped({f"runs/{RUN}/run.json": b"{}"}, zipfile.ZIP_LZMA),
        *map(zipped, renamed),
    ]


def _read_study(data: bytes | None, folder: Path) -> None:
    """As it is stored, or as somebody wrote it; ``other`` is a study whose journal holds another one."""
    results = folder / "results"
    for name in ("small", "other"):
        at(results / "studies" / name, "journal.log", _stored("studies/small/journal.log"))
    if data is None or data.lstrip().startswith(b"{"):
        at(results / "studies" / "small", "study.json", data)
        opened = Study.open(results / "studies" / "small")
    else:
        opened = Study.open(at(folder, "study.toml", data), results)
    Study.open(opened.spec, results)


def _study_seeds() -> list[bytes]:
    stored = _stored("studies/small/study.json")
    text = (FIXTURE.parent / "small.toml").read_bytes()
    return [
        *(
            stored,
            stored.replace(b'"small"', b'"other"'),
            stored.replace(b'"storage": ""', b'"storage": "redis://h"'),
        ),
        *(text, text + b'\nname = "gone"\n', b'name = "gone"\n' + text),
    ]


def _read_journal(data: bytes | None, folder: Path) -> None:
    study = folder / "results" / "studies" / "small"
    at(study, "journal.log", data)
    at(study, "study.json", _stored("studies/small/study.json"))
    Study.open(study).frame()


@cache
def _entry() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        StageCache(Path(folder)).put(
            "masks", "ab12", {"a": np.eye(3), "b": np.array(["person"])}, 0.1
        )
        (path,) = Path(folder).rglob("*.npz")
        return path.read_bytes()


def _read_entry(data: bytes | None, folder: Path) -> None:
    at(folder / "masks" / "ab", "ab12.npz", data)
    found = StageCache(folder).get("masks", "ab12")
    assert found is None or found.cost_s == 0.1


RECEIPT = fetch.Receipt(
    id="tum/x", url="https://host/x.tgz", sha256="0" * 64, size_bytes=1, checked=True, files=3
)


def _snapshot_seeds() -> list[bytes]:
    """Two frames; arrays that do not fit each other; objects; 300 MB of zeros."""
    sound = {"index": np.array([0, 5]), "count": np.array([3, 1]), "size": np.array([4, 10]),
             "points": np.zeros((4, 2), np.int16), "kept": np.ones(4, bool), "masked": np.array([True, False]),
             "masks": np.zeros((2, 4, 2), np.uint8)}  # fmt: skip
    odd: list[dict[str, Any]] = [
        {},
        {"count": np.array([3, 2])},
        {"masks": np.zeros((2, 4, 3), np.uint8)},
    ]
    odd += [
        {"kept": np.array([None] * 4)},
        {"points": np.zeros(0)},
        {"size": np.zeros(300 << 20, np.uint8)},
    ]
    return [
        written(lambda file, arrays=sound | each: np.savez_compressed(file, **arrays))
        for each in odd
    ]


RECORDS = [
    Target(
        "run record",
        _read_run,
        lambda: [
            _stored(f"runs/{RUN}/run.json").replace(RUN.encode(), run)
            for run in (RUN.encode(), OTHER)
        ],
        mutate_json,
    ),
    Target("index of runs", _read_index, lambda: [_index()]),
    Target(
        "stamps and trajectories of a run",
        _read_part,
        lambda: [
            _stored("sequences/*/timestamps.txt"),
            _stored(f"runs/{RUN}/trajectory_online.txt"),
        ],
    ),
    Target("frame log", _read_log, _log_seeds, mutate_lines),
    Target(
        "frame table",
        lambda data, folder: frames.load_frames(at(folder, frames.CSV_FILE, data)),
        lambda: [_stored(f"runs/{RUN}/frames.csv")],
    ),
    Target(
        "packed run",
        lambda data, folder: packing.unpack(data or b"", RunStore(folder)),
        _packed_seeds,
        mutate_zip,
    ),
    Target(
        "study's summary",
        lambda data, folder: StudySummary.read(at(folder, "record.json", data)),
        lambda: [_stored("studies/small/summary.json")],
        mutate_json,
    ),
    Target("stored study", _read_study, _study_seeds, mutate_json),
    Target(
        "journal of a study",
        _read_journal,
        lambda: [_stored("studies/small/journal.log")],
        mutate_lines,
    ),
    Target(
        "receipt of a fetch",
        lambda data, folder: fetch.Receipt.read(at(folder, "fetched.json", data)),
        lambda: [RECEIPT.to_json().encode()],
        mutate_json,
    ),
    Target(
        "snapshots of a run",
        lambda data, folder: artifacts.read_snapshots(
            at(folder, artifacts.SNAPSHOTS_FILE, data).parent
        ),
        _snapshot_seeds,
        mutate_zip,
    ),
    Target("stage cache entry", _read_entry, lambda: [_entry()]),
]


ROOT = Path(__file__).resolve().parents[2]
POSES = (
    b"# a comment\n1.0 0 0 0 0 0 0 1\n3.0,1,2,3,0,0,0,2\n2.0\t1 2 3 0 0 0.6 0.8\n"
    b"4.0 nan 0 0 0 0 0 1\n5 0 0 0 0 0 0 0\n"
)
LIST = (
    b"# timestamp filename\n1.000000 rgb/1.png\n2.000000 rgb/2.png\n1.5 rgb/3.png\n"
    b"2.0 rgb/4.png\nnan rgb/5.png\n3.0\n"
)
PAIRS = b"1.0 rgb/1.png 1.01 depth/1.png\n2.0 rgb/2.png 2.01 depth/2.png\n1.0 rgb/3.png 1.0 depth/3.png\n"
CAMERA_FILE = (
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
_FRAME = Frame(1, 1.0, np.zeros((12, 16, 3), np.uint8), np.zeros((12, 16), np.float32))


class FewSettings(settings.Settings):
    """As large as it takes to have a group: the settings of a whole system take a thousand times as long."""

    tracking: TrackingSettings = TrackingSettings()


def _text_of(data: bytes | None) -> str:
    return (data or b"").decode("utf-8", "surrogateescape")


def _of_text(read: Callable[[str], object]) -> Callable[[bytes | None, Path], object]:
    return lambda data, _: read(_text_of(data))


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
    sequence = reader.RecordedSequence(
        folder,
        layouts.read_tum(folder, 30.0),
        Camera(8, 8, 8.0, 8.0, 4.0, 4.0, depth_factor=5000.0),
        id="fuzz",
    )
    files = (*sequence._colour, *sequence._depth)
    assert files
    assert all((folder / file).resolve().is_relative_to(folder.resolve()) for file in files)


def _read_manifest(data: bytes | None, folder: Path) -> None:
    at(folder, "rgb/1.png", _PNG)
    compare_sums(folder, at(folder, fetch.MANIFEST, data))


def _read_coco(data: bytes | None, folder: Path) -> None:
    at(folder, "a.png", _PNG)
    at(folder, "b/c.png", _PNG)
    labelled = labelled_images.coco_images(str(at(folder, "annotations.json", data)))
    assert labelled.name
    assert labelled.version
    for index in range(min(len(labelled), 4)):
        labelled[index]


def _read_yolo(data: bytes | None, folder: Path) -> None:
    at(folder, "images/a.png", _PNG)
    at(folder, "labels/a.txt", data)
    labelled = labelled_images.yolo_images(str(folder))
    assert labelled.name
    assert labelled.version
    assert len(labelled) == 1
    labelled[0]


def _read_answer(text: str) -> None:
    answer = subprocess_tracker.parse_answer(text)
    with suppress(TrackerError):
        subprocess_tracker.read_track_answer(answer, _FRAME, "program at frame 1", lambda: 0.1)
    subprocess_tracker.read_final_answer(answer, "program at finalize")


def _harmless(text: str) -> None:
    """Whatever a record says, the terminal gets no escape, the file no half character, the path no way out."""
    assert not set(sanitise.printable(text)) & {
        chr(code) for code in (*range(9), *range(14, 32), 0x9B, 0x202E)
    }
    str(sanitise.storable({text: [text]})).encode()
    assert "\n" not in cell_text(text)
    if sanitise.is_inside(text):
        assert (Path("/root/x") / text).resolve().is_relative_to("/root/x")


def _study_texts() -> list[bytes]:
    """Studies; one with an unknown key, one of the old form, one whose sequence can be no path."""
    small = (FIXTURE.parent / "small.toml").read_bytes()
    far = b'tracker = "never-move"\ntune = ["/' + b"a" * 5000 + b'"]\n'
    return [small, (ROOT / "docs/studies/thresholds.toml").read_bytes(), b"bogus = 1\n" + small, far,
            b'pruner = "median"\nobjectives = ["ate", "speed"]\n' + far]  # fmt: skip


def _ids(text: str) -> None:
    for read in (parse_synthetic_id, catalogue.parse_frames, catalogue.entry_of):
        with suppress(DynslamError):
            read(text)


TEXTS = [
    Target(
        "TUM trajectory",
        lambda data, folder: load_tum(at(folder, "poses.txt", data)),
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
        lambda data, folder: read_kitti(
            at(folder, "poses.txt", data), at(folder, "times.txt", b"0\n0.1\n")
        ),
        lambda: [
            *(
                b"1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1 0 1 0 2 0 0 1 3" + b"\n" * ends
                for ends in (1, 2)
            ),
            *(
                b"# none\n\n",
                b"1 0 0 0 0 1 0 0 0 0 1 x\n",
                b"1 2 3\n",
                b"2 0 0 0 0 2 0 0 0 0 2 0\n",
            ),
        ],
    ),
    Target(
        "list of images",
        lambda data, folder: files.read_image_list(at(folder, "rgb.txt", data)),
        lambda: [LIST],
    ),
    Target(
        "associations",
        lambda data, folder: files.read_associations(at(folder, "a.txt", data)),
        lambda: [PAIRS],
    ),
    Target(
        "folder in TUM layout",
        _read_folder,
        lambda: [
            LIST,
            LIST.replace(b"rgb/2", b"../2"),
            PAIRS,
            POSES,
            PAIRS.replace(b"rgb/2", b"../2"),
        ],
    ),
    Target(
        "manifest of a fetch",
        _read_manifest,
        lambda: [b"0" * 64 + b"  rgb/1.png\n" + b"1" * 64 + b"  gone.png\n"],
    ),
    Target(
        "checksums of a bank",
        lambda data, folder: bank.verify(at(folder, bank.SUMS, data).parent),
        lambda: [b"0" * 64 + b"  runs/x\n" + b"1" * 64 + b"  ../gone\n", b"x\n"],
    ),
    Target(
        "description of a bank",
        lambda data, folder: read_description(at(folder, DESCRIPTION_FILE, data).parent),
        lambda: [b'{"protocol": "tum-rgbd/v1", "probes": {"synthetic/a?scene=0": "00"}}'],
    ),
    Target(
        "manifest of a bank",
        lambda data, folder: bank.read_manifest(at(folder, "m.toml", data)),
        lambda: [
            (ROOT / "docs/how-to/authors.toml").read_bytes()[:3000],
            b"trajectory = [1]\n",
            b"[[trajectory]]\n",
        ],
    ),
    Target(
        "camera",
        lambda data, folder: cameras.read_camera(at(folder, "camera.toml", data)).camera(),
        lambda: [
            CAMERA_FILE,
            b'name = "tum-fr1"\n',
            b'name = "x"\n',
            b"width = 640\n",
            b"fps = " + b"[" * 5000,
        ],
    ),
    Target(
        "settings file",
        lambda data, folder: settings.apply_overrides(
            FewSettings(), toml.read_settings(at(folder, "s.toml", data))
        ),
        lambda: [
            b"[settings]\n[settings.tracking]\nradius_px = 15\n",
            *(b"a.b = 1\n", b"settings = 3\n", b'tracking.radius_px = "' + b"a" * 300 + b'"\n'),
            *(b"tracking.radius_px = 0x" + b"f" * 5000 + b"\n",),
        ],
    ),
    Target(
        "--set",
        _of_text(
            lambda text: settings.apply_overrides(
                FewSettings(), settings.parse_assignments(text.split("\n"))
            )
        ),
        lambda: [
            b"tracking.radius_px=15\ntracking.local_map=all",
            *(b"x=1", b"tracking=1", b"tracking.radius_px.x=1", b"a.b.c=1", b"tracking.x=1"),
            *(
                b"tracking.radius_px=[1]",
                b"tracking.radius_px=" + b"9" * 4999,
                b"tracking.radius_px",
            ),
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
    Target(
        "study",
        lambda data, folder: study_file.read_study(at(folder, "s.toml", data)),
        _study_texts,
    ),
    Target(
        "COCO annotations",
        _read_coco,
        lambda: [
            json.dumps(COCO).encode(),
            b'{"images": [], "annotations": [], "categories": []}',
            *(
                json.dumps(
                    COCO | {"annotations": [{**COCO["annotations"][0], "segmentation": odd}]}
                ).encode()
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
        lambda: [
            b"0 0.1 0.1 0.9 0.1 0.9 0.9\n56 0 0 1 0 1 1\n\n",
            b"-1 0 0\n",
            b"0 nan 0\n",
            b"0 0 0\n",
        ],
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
                *(
                    {"trajectory": "x"},
                    {"T_world_cam": "x"},
                    {"stats": []},
                    {"state": 3},
                    {"dynamic_mask": "x"},
                ),
            )
        ],
        mutate_json,
    ),
    Target(
        "web address",
        lambda data, _: download.check_address(_text_of(data), checked=False),
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
    Target(
        "names and texts", _of_text(_harmless), lambda: [b"rgb/1.png", "Zoë \x1b[2J\u202e".encode()]
    ),
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


LENS = Camera(16, 12, 20.0, 20.0, 8.0, 6.0)


def _encoded(*suffixes: str, image: np.ndarray | None = None) -> list[bytes]:
    if image is None:
        image = np.random.default_rng(0).integers(0, 255, (12, 16, 3), np.uint8)
    return [cv2.imencode(suffix, image)[1].tobytes() for suffix in suffixes]


def _colours() -> list[bytes]:
    grey = np.full((12, 16), 80, np.uint8)
    deep = np.full((12, 16, 3), 999, np.uint16)
    return [*_encoded(".png", ".jpg", ".bmp", ".tiff", ".ppm"), *_encoded(".png", image=grey),
            *_encoded(".png", image=np.full((12, 16, 4), 80, np.uint8)), *_encoded(".png", image=deep),
            *_odd_headers()]  # fmt: skip


def _odd_headers() -> list[bytes]:
    """Files that claim to be huge, or to be something that they are not."""
    start = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + b"IHDR"
    bitmap = b"BM" + bytes(12) + struct.pack("<IHH", 12, 16, 12) + bytes(99)
    jpeg = b"\xff\xd8\xff\xff\xd0\x00\xff\xc0\x00\x11\x08\xff\xff\xff\xff" + bytes(20)
    huge = start + struct.pack(">IIBB", 65535, 60000, 8, 2) + bytes(60) + b"IEND\xaeB`\x82"
    tiff = b"II*\0\x08\0\0\0\0\0"
    pnm = b"P5 99999 99999 255\n"
    return [
        huge,
        start[:20],
        bitmap,
        b"BM",
        jpeg,
        tiff,
        pnm,
        b"no image",
        _encoded(".png")[0][:-20],
    ]


def _depths() -> list[bytes]:
    deep = np.arange(192, dtype=np.uint16).reshape(12, 16) * 90
    metres = _npy(np.full((12, 16), 1.5, np.float32))
    return [
        metres,
        *_encoded(".png", ".tiff", ".pgm", image=deep),
        *_encoded(".png", image=deep[:4]),
        *_colours(),
    ]


def _npy(array: np.ndarray) -> bytes:
    return written(lambda file: np.save(file, array))


def _rendered() -> list[bytes]:
    png = encode_png(np.full((12, 16, 3), 9, np.uint8))
    return [png, png[:-6], png[:-12], png[:30] + b"x" + png[31:], png + b"x"]


def _read_colour(data: bytes | None, folder: Path) -> None:
    path = at(folder, "1.png", data)
    images.read_image(path)  # any size
    image = reader.read_colour(path, size=(16, 12), mismatch="but the camera is 16x12")
    assert image.shape == (12, 16, 3)
    assert image.dtype == np.uint8


def _read_depth(data: bytes | None, folder: Path) -> None:
    path = at(folder, "1.npy" if data and data.startswith(b"\x93") else "1.png", data)
    reader.read_depth(path, 5000.0, furthest_m=2.0)  # any size
    image = reader.read_depth(path, 5000.0, size=(16, 12), mismatch="but the camera is 16x12")
    assert image.shape == (12, 16)
    assert image.dtype == np.float32


def _read_mask(data: bytes | None, folder: Path) -> None:
    stamped = data is not None and len(data) % 2 == 0
    at(folder, "0.9.png" if stamped else "0.png", b"")
    at(folder, "1.0.png" if stamped else "1.png", data)
    at(folder, recorded.CLASSES_FILE, b'{"1": "person"}')
    segmenter = recorded.RecordedSegmenter(folder)
    segmenter.missing(np.array([1.0, 2.0]))
    segmenter.segment(_FRAME)


def _read_rendered(data: bytes | None, folder: Path) -> None:
    store = FrameStore(folder, LENS)
    if data == b"":
        (folder / "rgb" / "1.000000.png").mkdir(parents=True)
    else:
        at(folder, "rgb/1.000000.png", data)
    image = store.read("rgb", 1.0)
    assert image is None or image.shape == (12, 16, 3)


def _tar(*members: tuple[str, bytes, bytes], form: int = tarfile.GNU_FORMAT) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=form) as tar:
        for name, content, kind in members:
            info = tarfile.TarInfo(name)
            info.size = len(content)
            info.type = kind
            tar.addfile(info, io.BytesIO(content))
    return buffer.getvalue()


def _archives() -> list[bytes]:
    lines = b"1 a\n" * 50
    link = zipfile.ZipInfo("seq/link")
    link.external_attr = 0o120777 << 16
    plain = ("seq/", b"", tarfile.DIRTYPE), ("seq/rgb.txt", lines, tarfile.REGTYPE)
    long = ("seq/" + "n" * 150 + "/" + "m" * 99, b"x", tarfile.REGTYPE)
    packed = zipped({"seq/": b"", "seq/rgb.txt": lines})
    return [
        *(gzip.compress(_tar(*plain), 1), gzip.compress(_tar(*plain), 1)[:-20], _tar(*plain, long)),
        *(
            _tar(*plain, long, form=tarfile.PAX_FORMAT),
            _tar(*plain, *plain),
            _tar(("seq/link", b"", tarfile.SYMTYPE)),
        ),
        *(
            _tar(*plain, *plain[1:]),
            packed,
            packed.replace(b"1 a", b"1 b", 1),
            zipped({"../rgb.txt": lines}),
        ),
        *(zipped({"seq/rgb.txt": lines}, zipfile.ZIP_BZIP2), zipped({link: lines})),
    ]


def _tar_checked(data: bytes, random: Random) -> bytes:
    """Damage in a tar header under a right checksum, and gzip around it."""
    try:
        plain = bytearray(gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data)
    except Exception:  # a seed whose compression is damaged already
        return mutate(data, [data], random)
    blocks = [
        at_ for at_ in range(0, len(plain) - 511, 512) if plain[at_ + 257 : at_ + 262] == b"ustar"
    ]
    if not blocks:
        return mutate(data, [data], random)
    start = random.choice(blocks)
    block = bytearray(mutate(bytes(plain[start : start + 500]), [], random)[:500].ljust(512, b"\0"))
    if random.random() < 0.3:
        block[124:136] = struct.pack(">BxxxQ", 0x80, random.getrandbits(62))  # a size in base 256
    if random.random() < 0.5:
        block[156:157] = random.choice([b"0", b"L", b"K", b"x", b"g", b"S", b"2", b"5", b"7", b"Z"])
    block[257:265] = plain[start + 257 : start + 265]
    block[148:156] = b" " * 8
    block[148:156] = b"%06o\0 " % sum(block)
    plain[start : start + 512] = block
    return gzip.compress(bytes(plain), 1) if random.random() < 0.5 else bytes(plain)


def _extract(data: bytes | None, folder: Path) -> None:
    target = folder / "out"
    target.mkdir()
    sums = fetch.extract(at(folder, "archive.tgz", data or b""), target, lambda progress: None)
    assert all((target / name).resolve().is_relative_to(target.resolve()) for name in sums)
    assert not any(path.is_symlink() for path in target.rglob("*"))


@cache
def _checkpoints() -> list[bytes]:
    import torch  # takes a second, of every process that collects

    from dynslam_bench.segmentation.networks.backbone import NetworkConfig
    from dynslam_bench.segmentation.networks.loading import FORMAT
    from dynslam_bench.segmentation.networks.network import MaskRCNN

    small = NetworkConfig(blocks=(1, 1, 1, 1), bottleneck=False, stem=1, channels=1, classes=("person",),
                          box_hidden=1, mask_channels=1, mask_layers=1)  # fmt: skip
    state = MaskRCNN(small).state_dict()
    ours = {"format": FORMAT, "config": small.model_dump_json(), "model": state}
    odd = next(iter(state))
    contents: list[Any] = [
        *(
            ours,
            {"model": state},
            state,
            {},
            [1],
            {"a": 1},
            ours | {"config": "{}"},
            ours | {"format": "x"},
        ),
        *(
            ours | {"model": state | {odd: value}}
            for value in (torch.zeros(2), torch.zeros(1).expand(10**6, 10**6))
        ),
        *(
            ours | {"model": state | {odd: value}}
            for value in (torch.full_like(state[odd], torch.nan), torch.zeros(2).to_sparse())
        ),
        ours
        | {"config": small.model_copy(update={"stem": 4096, "channels": 4096}).model_dump_json()},
        *(
            {"model": {**state, "roi_heads.box_predictor.cls_score.weight": torch.zeros(size, 4)}}
            for size in (91, 7)
        ),
    ]
    stored = [
        written(lambda file, content=content: torch.save(content, file)) for content in contents
    ]
    return [
        *stored,
        written(lambda file: torch.save(ours, file, _use_new_zipfile_serialization=False)),
        zipped({"archive/data.pkl": bytes(1 << 20)}, zipfile.ZIP_DEFLATED),
    ]


def _load_network(data: bytes | None, folder: Path) -> object:
    from dynslam_bench.segmentation.networks.loading import load_network

    return load_network(at(folder, "net.pt", data))


def _onnx(metadata: dict[str, bytes]) -> bytes:
    """A model of one input and one output, written by hand."""

    def field(number: int, body: bytes) -> bytes:
        return bytes([number << 3 | 2, len(body)]) + body

    shape = b"".join(field(1, bytes([1 << 3, size])) for size in (1, 3, 64, 64))
    value = field(1, b"images") + field(2, field(1, bytes([1 << 3, 1]) + field(2, shape)))
    graph = field(5, field(8, b"weight")) + field(11, value) + field(12, value)
    return field(7, graph) + b"".join(
        field(14, field(1, key.encode()) + field(2, value)) for key, value in metadata.items()
    )


def _layouts() -> list[bytes]:
    """Models with metadata; the output is one of three classes in planes."""
    return [
        _onnx({"names": b"['a', 'person', 'b']", "task": b"semantic"}),
        _onnx({"names": b"{1: 'person', 2: 'b'}", "args": b"{'nms': False}", "end2end": b"True"}),
        _onnx({"names": b"{0xffff: 'person'}", "args": b"[[[]]]"}),
    ]


def _find_layout(data: bytes | None, folder: Path) -> object:
    path = at(folder, "net.onnx", data)
    _, outputs, metadata = onnx_header.read_header(path)
    return onnx_layout.detect_layout(outputs, metadata, (64, 64), str(path))


def _read_prepared(data: bytes | None, folder: Path) -> None:
    np.save(folder / "labels.npy", np.zeros((1, 4, 4), np.uint8))
    at(folder, "names.json", b'[["person"]]' if len(data or b"") % 2 == 0 else b"[]")
    at(folder, "images.npy", data)
    labelled_images.PreparedImages(folder, ("person",))


def _vocabularies() -> list[bytes]:
    node = " ".join(["0", "1", *["7"] * 32, "0.5"])
    texts = (f"10 1 0 0\n{node}\n{node}\n\n", f"10 1 0 0\n{node}\nx\n", f"10 1 0 0\n{node.replace('1', '0', 1)}\n",
             "10 1 0 0\n9" + node[1:], "10 1 0 0\n", "x", "99 1 0 0\n")  # fmt: skip
    return [lzma.compress(text.encode()) for text in texts]


def _repressed(data: bytes, random: Random) -> bytes:
    try:
        return lzma.compress(mutate(lzma.decompress(data), [data], random), preset=0)
    except (lzma.LZMAError, EOFError):
        return mutate(data, [data], random)


PREPARED = _npy(np.zeros((1, 4, 4, 3), np.uint8))
BINARIES = [
    Target("colour image", _read_colour, _colours, mutate_png),
    Target("depth image", _read_depth, _depths, mutate_png),
    Target(
        "recorded mask",
        _read_mask,
        lambda: [
            *_encoded(".png", image=np.eye(12, 16, dtype=np.uint8)),
            *_encoded(".png", image=2 * np.eye(12, 16, dtype=np.uint8)),
            *_encoded(".png", image=np.zeros((12, 16), np.uint8)),
            *_colours(),
        ],
        mutate_png,
    ),
    Target("rendered frame", _read_rendered, _rendered, mutate_png),
    Target("archive", _extract, _archives, _tar_checked),
    Target(
        "checkpoint",
        _load_network,
        _checkpoints,
        mutate_zip,
    ),
    Target(
        "TensorFlow Lite header",
        lambda data, folder: str(tflite_header.read_tflite_header(at(folder, "net.tflite", data))),
        lambda: [tflite(), tflite(labels=()), tflite(outputs=((1, 10), (1, 2, 3)), labels=())],
    ),
    Target(
        "motion covariances",
        lambda data, folder: read_motion_covariances(at(folder, "covariances.txt", data)),
        lambda: [
            b"# heading\n1.5 " + b"0.1 " * 36 + b"\n2.5 " + b"nan " * 36 + b"\n",
            b"inf " + b"1e400 " * 36,
            b"1.5 2\n",
        ],
    ),
    Target(
        "ONNX header",
        lambda data, folder: str(onnx_header.read_header(at(folder, "net.onnx", data))),
        lambda: [_onnx({"names": b"{0: 'person'}"}), b"\x80" * 20],
    ),
    Target("ONNX layout", _find_layout, _layouts),
    Target("prepared images", _read_prepared, lambda: [PREPARED, PREPARED + b"x"]),
    Target(
        "vocabulary",
        lambda data, folder: orbslam3._check(lzma.decompress(data or b""), folder / "voc.txt"),
        _vocabularies,
        _repressed,
        allowed=(orbslam3.TrackerError, lzma.LZMAError, EOFError, ValueError),
    ),
]


SIZE = (16, 12)


@cache
def _files(name: str) -> dict[str, bytes]:
    """The files of a small folder of a layout."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made) / "s"
        WRITERS[name](folder, random_poses(0), size=SIZE)
        return {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in folder.rglob("*")
            if path.is_file()
        }


GONE = 128
"""Added to an input's first byte, the file is missing."""


def _attacked(name: str, damaged: tuple[str, ...]) -> Target:
    """A target that damages one of some files, or takes it away; the first byte of an input says which."""

    def read(data: bytes | None, folder: Path) -> None:
        first = data[0] if data else 0
        for file, content in _files(name).items():
            at(folder, file, content)
        at(
            folder,
            damaged[first % GONE % len(damaged)],
            None if data is None or first >= GONE else data[1:],
        )
        contents = layouts.layout_of(name).read(folder, None)
        sequence = reader.RecordedSequence(
            folder,
            contents,
            Camera(*SIZE, 10.0, 10.0, 8.0, 6.0, depth_factor=1000.0),
            id="fuzz",
            any_depth_size=True,
        )
        for index in range(min(len(sequence), 3)):
            depth = sequence[index].depth
            assert np.isfinite(depth).all()
            assert (depth >= 0).all()

    def seeds() -> list[bytes]:
        found = []
        for which, file in enumerate(damaged):
            content = _files(name).get(file, b"")
            found += [bytes([which]) + content, bytes([which + GONE])]
            found += [
                bytes([which]) + re.sub(old, new, content)
                for place, old, new in ODD[name]
                if place == file
            ]
        return found

    return Target(f"layout {name}", read, seeds)


DAMAGED = {
    "eth3d": ("associated.txt", "calibration.txt", "groundtruth.txt"),
    "icl-nuim": ("livingRoom0.gt.freiburg", "second.gt.freiburg", "rgb/1.png"),
    "7-scenes": ("frame-000001.pose.txt", "frame-000001.depth.png", "frame-x.color.png"),
    "tartanair-shibuya": ("times.txt", "gt_pose.txt", "depth_0/000001.npy"),
    "openloris": ("sensors.yaml", "trans_matrix.yaml", "color.txt", "groundtruth.txt"),
    "vslam-lab": ("rgb.csv", "calibration.yaml", "groundtruth.csv"),
    "euroc": (
        "mav0/cam0/sensor.yaml",
        "mav0/cam0/data.csv",
        "mav0/depth0/data.csv",
        "mav0/depth0/sensor.yaml",
        "mav0/state_groundtruth_estimate0/data.csv",
    ),
}
SKEWED = (rb"0\.269463", b"5")
"""A rotation that is none."""
ODD: dict[str, list[tuple[str, bytes, bytes]]] = {
    "eth3d": [],
    "icl-nuim": [],
    "7-scenes": [
        ("frame-000001.pose.txt", rb"5\.43\S*", b"nan"),
        ("frame-000001.pose.txt", rb"5\.43\S*", b"7.0"),
    ],
    "tartanair-shibuya": [
        ("depth_0/000001.npy", rb"'<f4'", b"'<U1'"),
        ("depth_0/000001.npy", rb"12, 16", b"16, 12"),
        ("depth_0/000001.npy", rb"NUMPY\x01", b"NUMPY\x09"),
        ("gt_pose.txt", rb"(?m)^\S+ ", b""),
        ("gt_pose.txt", rb"0\.\d+", b"0"),
        ("gt_pose.txt", rb"(?s)\n.*", b""),
    ],
    "openloris": [
        ("sensors.yaml", rb"(?s).*", b"3"),
        ("trans_matrix.yaml", *SKEWED),
        ("groundtruth.txt", rb"(?m)^5\.", b"99."),
    ],
    "vslam-lab": [
        ("rgb.csv", rb"path_depth_0", b"path"),
        ("rgb.csv", rb"\n", b"\n\n"),
        ("rgb.csv", rb"(?s)\n.*", b""),
        ("groundtruth.csv", rb"qw", b"w"),
        ("groundtruth.csv", rb"0\.\d+", b"0"),
        ("calibration.yaml", rb"rgb_0", b"rgb_1"),
        ("calibration.yaml", rb"radtan5", b"fisheye"),
        ("calibration.yaml", rb"60\.5", b"-1"),
        ("calibration.yaml", *SKEWED),
        ("calibration.yaml", rb"\bT_BS: \S+", b"other: [0,"),
    ],
    "euroc": [
        ("mav0/cam0/sensor.yaml", *SKEWED),
        ("mav0/cam0/sensor.yaml", rb"T_BS", b"other"),
        ("mav0/cam0/sensor.yaml", rb"16, 12", b"0, 12"),
        ("mav0/cam0/data.csv", rb",\S+", b""),
        ("mav0/depth0/sensor.yaml", b"^", b"depth_factor: 5000\n"),
        ("mav0/state_groundtruth_estimate0/data.csv", rb"(?m),.*$", b""),
        ("mav0/state_groundtruth_estimate0/data.csv", rb"0\.\d+", b"0"),
    ],
}
"""Files, what is replaced in them, by what: those branches that damage at random seldom finds."""
LAYOUTS = [_attacked(name, files) for name, files in DAMAGED.items()]


EUROC = (
    formats.POSE_TABLES["euroc"][1]
    + "\n1000000000,0,0,0,1,0,0,0\n2000000000,1,2,3,0.5,0.5,0.5,0.5\n"
).encode()
VSLAM_LAB = (
    b"ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw\n1000000000,0,0,0,0,0,0,1\n2e9,1,2,3,0.6,0,0,0.8\n"
)
COLMAP = (
    b"# a comment\n1 1 0 0 0 0 0 0 1 rgb/1.5.png\n\n2 0.8 0 0 0.6 1 2 3 1 rgb/2.5.png\n3.0 4.0 -1 5 6 7\n"
    b"3 1 0 0 0 4 5 6 1 c.png\n\n"
)
RGB = b"1.5 rgb/1.5.png\n2.5 rgb/2.5.png\n3.5 c.png\n"


def _read_colmap(data: bytes | None, folder: Path) -> None:
    """With the stamps in the names, or in a list: a part of the inputs each."""
    at(folder, formats.IMAGES, data)
    formats.read_trajectory(
        folder, at(folder, "rgb.txt", RGB) if len(data or b"") % 2 == 0 else None
    )


def _read_provenance(data: bytes | None, folder: Path) -> None:
    """Asked of the file and of its folder; whatever it says, no other file is looked at, and nothing is raised."""
    at(folder, transfer.PROVENANCE_FILE, data)
    file = at(folder, "trajectory.txt", b"# none\n")
    assert [
        asked for asked in (file, folder) if not isinstance(transfer.stated_provenance(asked), str)
    ] == []


def _provenances() -> list[bytes]:
    digest = transfer.digest_of(Path(__file__))
    shared = {
        "format": "tum",
        "which": "final",
        "run": RunRecord.read(Path(__file__).parents[1] / "runs" / "data" / "run.json"),
    }
    files = ({"trajectory.txt": digest}, {"../x": digest}, {"a\x00b": digest}, {})
    return [transfer.Provenance(files=each, **shared).to_json().encode() for each in files]


def _maps() -> list[bytes]:
    with tempfile.TemporaryDirectory() as made:
        path = Path(made) / "map.ply"
        positions = np.random.default_rng(0).normal(size=(4, 3))
        map_files.write_ply(
            path, MapOutputs((), np.arange(4), positions, np.zeros((4, 3), np.uint8), np.arange(4))
        )
        return [path.read_bytes()]


FEATURES = map_files.MapFeatures(extractor="orb", levels=8, scale_factor=1.2)


def _sound_map() -> dict[str, Any]:
    """Two keyframes of three and two features, two points that both see, a submap."""
    header = map_files.MapHeader(
        sensors="rgbd",
        camera=map_files.described(LENS),
        features=FEATURES,
        next_keyframe=4,
        next_point=9,
        made_by="nobody",
    )
    return {
        map_files.HEADER: np.frombuffer(header.to_json().encode(), np.uint8),
        "kf_id": np.array([0, 2]), "kf_map": np.array([0, 1]), "kf_pose": np.tile(np.eye(4), (2, 1, 1)),
        "kf_count": np.array([3, 2]), "kf_raw": np.full((5, 2), 4.0, np.float32), "kf_response": np.ones(5, np.float32),
        "kf_xy": np.full((5, 2), 4.0), "kf_right": np.array([1.0, np.nan, 1.0, 1.0, 1.0]),
        "kf_z": np.array([1, 0, 1, 1, 1], np.float32), "kf_octave": np.array([0, 1, 2, 7, 0], np.int8),
        "kf_angle": np.zeros(5, np.float32), "kf_info": np.ones(5), "kf_info_right": np.ones(5),
        "kf_words": np.zeros((5, 4), np.uint64),
        "id": np.array([3, 8]), "position": np.array([[0.0, 0, 1], [0.1, 0, 1]]), "normal": np.eye(3)[[2, 2]],
        "far": np.ones(2), "words": np.zeros((2, 4), np.uint64), "rgb": np.zeros((2, 3), np.uint8),
        "visible": np.ones(2, np.int32), "found": np.ones(2, np.int32), "born": np.array([0, 1]),
        "n_obs": np.array([2, 2], np.int32), "obs_kf": np.array([0, 1, 0, 1], np.int32),
        "obs_ft": np.array([2, 0, 0, 1], np.int32), "submap_start": np.zeros((1, 3)),
        "submap_anchor": np.zeros((1, 3)), "submap_bound": np.array([np.inf]),
    }  # fmt: skip


def _map_seeds() -> list[bytes]:
    """A sound map, and one for every kind of fault."""
    sound = _sound_map()
    odd: list[tuple[str, np.ndarray]] = [
        ("kf_count", np.array([2**60, 2])), ("kf_right", np.ones(5)), ("kf_pose", 2 * np.ones((2, 4, 4))),
        ("far", np.zeros(2)), ("id", np.array([3, 3])), ("kf_id", np.array([0, 9])), ("rgb", np.zeros((2, 4))),
        ("obs_ft", np.array([2, 2, 0, 1], np.int32)), ("obs_ft", np.array([2, 1, 0, 0], np.int32)),
        ("n_obs", np.array([1, 1], np.int32)), ("visible", np.zeros(2, np.int32)), ("more", np.zeros(1)),
        ("position", np.full((2, 3), np.nan)), (map_files.HEADER, np.array([255], np.uint8)),
        (map_files.HEADER, np.frombuffer(b"{}", np.uint8)),
    ]  # fmt: skip
    nothing = {name: value[:0] for name, value in sound.items() if name != map_files.HEADER}
    faulty = [
        sound,
        *(sound | {name: value} for name, value in odd),
        sound | nothing,
        {"header ": np.zeros(1)},
    ]
    return [written(lambda file, arrays=arrays: np.savez(file, **arrays)) for arrays in faulty]


def _read_map(data: bytes | None, folder: Path) -> None:
    """What is read is worked on as a run does, whose compiled loops check no index."""
    atlas = open_atlas(str(at(folder, "map.npz", data)), LENS, FEATURES, depth=True)
    slam_map = atlas.map
    slam_map.refresh(slam_map.points)
    for slot in slam_map.keyframes.tolist():
        slam_map.covisible(slot)
        slam_map.project(slam_map.kf_pose[slot], slam_map.points)
    packed(atlas.map, atlas.submaps.values())
    slam_map.remove_keyframe(int(slam_map.keyframes[0]))


EXCHANGE = [
    Target(
        "table of poses",
        lambda data, folder: formats.read_trajectory(at(folder, "data.csv", data)),
        lambda: [EUROC, VSLAM_LAB],
    ),
    Target("COLMAP images", _read_colmap, lambda: [COLMAP, COLMAP + b"\n"]),
    Target(
        "map of points", lambda data, folder: map_files.read_ply(at(folder, "map.ply", data)), _maps
    ),
    Target("provenance of an export", _read_provenance, _provenances),
    Target("map of a run", _read_map, _map_seeds, mutate_zip),
]


TARGETS = [*RECORDS, *TEXTS, *BINARIES, *LAYOUTS, *EXCHANGE]
