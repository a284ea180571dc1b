"""Readers of what this package has stored: records, tables, packed runs, studies, cache entries."""

import io
import json
import os
import tempfile
import zipfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dynslam_bench.core.records import Record
from dynslam_bench.core.stage_cache import StageCache  # what of the cache reads
from dynslam_bench.evaluation.protocol import get_protocol
from dynslam_bench.reports.model.load import load_runs
from dynslam_bench.runs import RunStore
from dynslam_bench.runs import artifacts as snapshots
from dynslam_bench.runs import frames as rows
from dynslam_bench.runs import running as packing
from dynslam_bench.runs.frames import FrameLog, load_frames
from dynslam_bench.runs.store import INDEX_FILE, list_runs
from dynslam_bench.sequences.fetch import Receipt
from dynslam_bench.tuning import Study, StudySummary

from .campaign import Target, at, written
from .mutate import mutate_json, mutate_lines, mutate_zip

FIXTURE = Path(__file__).resolve().parents[1] / "fixtures" / "results"
RUN = "a7abe04996a79cc4"


@cache
def _stored(name: str) -> bytes:
    (path,) = FIXTURE.glob(name)
    return path.read_bytes()


def _other(data: bytes) -> bytes:
    """The same of the other run."""
    return data.replace(RUN.encode(), b"e7f8d4df9db4bb16")


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
    assert [row["run_id"] for row in rows] == [RUN] and len(unreadable) == 1
    assert store.score(store.read(RUN)).run_id == RUN
    loaded = load_runs([store], get_protocol("tum-rgbd/v1"))
    assert [row.run_id for row in loaded.rows] == [RUN] and len(loaded.unreadable) == 1


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
    log = FrameLog.read(at(folder, rows.FRAMES_FILE, data))
    log.write(folder, "comment")
    log.timings(), log.mask_iou(), log.lost_streak(), log.epipolar_skipped()


def _log_seeds() -> list[bytes]:
    made = rows.read_csv(FIXTURE / "runs" / RUN / "frames.csv")
    pose = [0.0, 0.1, 0.2, 0.0, 0.0, 0.0, 1.0]
    lines = [json.dumps({**vars(row), "pose": pose}) + "\n" for row in made]
    odd = ({"pose": pose[:6]}, {"stats": {"a": "x"}}, {"state": "asleep"}, {"timestamp": "nan"}, {"x": 1})
    one = json.loads(lines[0])
    return [
        *("".join(lines).encode(), lines[0].encode(), "".join(lines).encode()[:-30], lines[0].encode() * 2, b"[]\n"),
        *(json.dumps(one | each).encode() + b"\n" for each in odd),
    ]


def _packed_seeds() -> list[bytes]:
    store = RunStore(FIXTURE)
    packed = packing.pack(store, store.read(RUN))
    lying = bytearray(packed)
    start = lying.index(b"PK\x01\x02") + 24  # the size that the first file claims
    lying[start : start + 4] = b"\xfe\xff\xff\xff"
    squeezed = io.BytesIO()
    with zipfile.ZipFile(squeezed, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr(f"runs/{RUN}/run.json", "{}")
    return [packed, bytes(lying), squeezed.getvalue(), _renamed(packed, "0" * 16), _renamed(packed, "zz")]


def _renamed(packed: bytes, run: str) -> bytes:
    """The same archive under another run's name."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(packed)) as old, zipfile.ZipFile(buffer, "w") as new:
        for name in old.namelist():
            new.writestr(name.replace(RUN, run), old.read(name))
    return buffer.getvalue()


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
    stored, text = _stored("studies/small/study.json"), (FIXTURE.parent / "small.toml").read_bytes()
    return [
        *(stored, stored.replace(b'"small"', b'"other"'), stored.replace(b'"storage": ""', b'"storage": "redis://h"')),
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
        StageCache(Path(folder)).put("masks", "ab12", {"a": np.eye(3), "b": np.array(["person"])}, 0.1)
        (path,) = Path(folder).rglob("*.npz")
        return path.read_bytes()


def _read_entry(data: bytes | None, folder: Path) -> None:
    at(folder / "masks" / "ab", "ab12.npz", data)
    found = StageCache(folder).get("masks", "ab12")
    assert found is None or found.cost_s == 0.1


def _summary(cls: type[Record], seed: str) -> dict[str, Any]:
    return {
        "read": lambda data, folder: cls.read(at(folder, "record.json", data)),
        "seeds": lambda: [_stored(seed)],
        "mutation": mutate_json,
    }


def _receipt_seeds() -> list[bytes]:
    made = Receipt(id="tum/x", url="https://host/x.tgz", sha256="0" * 64, size_bytes=1, checked=True, files=3)
    return [made.to_json().encode()]


def _snapshot_seeds() -> list[bytes]:
    """Two frames; arrays that do not fit each other; objects; 300 MB of zeros."""
    sound = {"index": np.array([0, 5]), "count": np.array([3, 1]), "size": np.array([4, 10]),
             "points": np.zeros((4, 2), np.int16), "kept": np.ones(4, bool), "masked": np.array([True, False]),
             "masks": np.zeros((2, 4, 2), np.uint8)}  # fmt: skip
    odd: list[dict[str, Any]] = [{}, {"count": np.array([3, 2])}, {"masks": np.zeros((2, 4, 3), np.uint8)}]
    odd += [{"kept": np.array([None] * 4)}, {"points": np.zeros(0)}, {"size": np.zeros(300 << 20, np.uint8)}]
    return [written(lambda file, arrays=sound | each: np.savez_compressed(file, **arrays)) for each in odd]


TARGETS = [
    Target(
        "run record",
        _read_run,
        lambda: [_stored(f"runs/{RUN}/run.json"), _other(_stored(f"runs/{RUN}/run.json"))],
        mutate_json,
    ),
    Target("index of runs", _read_index, lambda: [_index()]),
    Target(
        "stamps and trajectories of a run",
        _read_part,
        lambda: [_stored("sequences/*/timestamps.txt"), _stored(f"runs/{RUN}/trajectory_online.txt")],
    ),
    Target("frame log", _read_log, _log_seeds, mutate_lines),
    Target(
        "frame table",
        lambda data, folder: load_frames(at(folder, rows.CSV_FILE, data)),
        lambda: [_stored(f"runs/{RUN}/frames.csv")],
    ),
    Target("packed run", lambda data, folder: packing.unpack(data or b"", RunStore(folder)), _packed_seeds, mutate_zip),
    Target("study's summary", **_summary(StudySummary, "studies/small/summary.json")),
    Target("stored study", _read_study, _study_seeds, mutate_json),
    Target("journal of a study", _read_journal, lambda: [_stored("studies/small/journal.log")], mutate_lines),
    Target(
        "receipt of a fetch",
        lambda data, folder: Receipt.read(at(folder, "fetched.json", data)),
        _receipt_seeds,
        mutate_json,
    ),
    Target(
        "snapshots of a run",
        lambda data, folder: snapshots.read_snapshots(at(folder, snapshots.SNAPSHOTS_FILE, data).parent),
        _snapshot_seeds,
        mutate_zip,
    ),
    Target("stage cache entry", _read_entry, lambda: [_entry()]),
]
