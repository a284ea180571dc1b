"""Many runs: resuming, retrying, parallel and elsewhere, under a jumping clock; imported trajectories; suites."""

import errno
import io
import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import tarfile
import time
import zipfile
from collections.abc import Iterator
from concurrent.futures import (
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from dataclasses import astuple
from itertools import cycle
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
from helpers import envs_toys
from helpers.envs_toys import TARGET, truth, write_folder
from helpers.waiting import until

from dynslam_bench.api import bench, report
from dynslam_bench.cli.running import parse_shard, show_workers
from dynslam_bench.core.errors import DynslamError, InfrastructureError, RunError
from dynslam_bench.geometry import Trajectory, read_tum, write_tum
from dynslam_bench.reports import load_frame
from dynslam_bench.runs import (
    RunEvent,
    RunSpec,
    RunStore,
    export_run,
    import_trajectory,
    merge,
    open_store,
    resolve,
    run_many,
    run_one,
    score,
)
from dynslam_bench.runs.cluster import DaskWorkers
from dynslam_bench.runs.identity import Resolver
from dynslam_bench.runs.packing import pack, unpack
from dynslam_bench.runs.process.fork_server import START_VARIABLE
from dynslam_bench.sequences.catalogue import entry_of, sequence_ids
from dynslam_bench.sequences.synthetic import parse_synthetic_id
from dynslam_bench.suites import load_suite, suite_names
from dynslam_bench.trackers.registry import TRACKERS

pytestmark = pytest.mark.slow


def specs(folder: str, seeds: range, **change) -> list[RunSpec]:
    return [
        RunSpec(tracker=TARGET, sequence=folder, frames=(0, 8), seed=seed, **change)
        for seed in seeds
    ]


def follow(events: list) -> dict:
    return {"on_event": lambda event: events.append((event.kind, event.run_id))}


def kinds(events: list) -> dict[str, int]:
    found = [kind for kind, _ in events if kind != "progress"]
    return {kind: found.count(kind) for kind in sorted(set(found))}


def test_resuming_is_a_set_difference(store: RunStore, toy_folder: str) -> None:
    events: list = []
    first = list(run_many(specs(toy_folder, range(2)), results=store, **follow(events)))
    assert kinds(events) == {"finished": 2, "started": 2}
    events.clear()
    second = run_many(specs(toy_folder, range(4)), results=store, jobs=2, **follow(events))
    assert kinds(events) == {"finished": 2, "reused": 2, "started": 2}
    assert second[:2] == first
    assert [record.seed for record in second] == [0, 1, 2, 3]
    assert all(score(store, record).metrics["ate_rmse_m"] > 0 for record in second)


def test_a_run_of_a_study_is_an_ordinary_one_once_it_is_asked_for_without(
    store: RunStore, toy_folder: str
) -> None:
    (made,) = run_many(specs(toy_folder, range(1), study="mine"), results=store)
    assert made.study == "mine"
    assert list(run_many(specs(toy_folder, range(1), study="other"), results=store)) == [made]
    (asked,) = run_many(specs(toy_folder, range(1)), results=store)
    assert asked.study == ""
    assert asked.run_id == made.run_id
    assert list(run_many(specs(toy_folder, range(1), study="mine"), results=store)) == [asked]
    assert store.get(made.run_id) == asked


def test_one_failure_stops_nothing_and_is_made_again_only_on_request(
    store: RunStore, toy_folder: str
) -> None:
    wanted = [
        *specs(toy_folder, range(1), settings={"mode": "segfault"}),
        *specs(toy_folder, range(2)),
    ]
    assert [record.status for record in run_many(wanted, results=store)] == ["crashed", "ok", "ok"]
    for retry, made in (((), 0), (("failed",), 1), (("timeout",), 0), (("ok",), 2)):
        events: list = []
        run_many(wanted, results=store, retry=retry, **follow(events))
        assert kinds(events).get("started", 0) == made, retry
    with pytest.raises(RunError, match="unknown status 'broken'"):
        run_many(wanted, results=store, retry=("broken",))


def test_a_wrong_name_is_refused_before_anything_runs(store: RunStore, toy_folder: str) -> None:
    wrong = [*specs(toy_folder, range(2)), RunSpec(tracker="orb-slam", sequence=toy_folder)]
    with pytest.raises(DynslamError, match=r"unknown tracker 'orb-slam'.*orb-slam2"):
        run_many(wrong, results=store)
    assert store.ids() == []
    with pytest.raises(RunError, match="jobs is 0"):
        run_many(specs(toy_folder, range(1)), results=store, jobs=0)


def test_what_cannot_be_looked_up_is_set_aside_where_somebody_is_told(
    store: RunStore, toy_folder: str
) -> None:
    wrong = (
        {"tracker": "orb-slam"},
        {"settings": {"speed": 1}},
        {"sequence": "nowhere/x"},
        {"frames": (5, 6)},
    )
    asked = [
        spec.model_copy(update=change)
        for spec in specs(toy_folder, range(1))
        for change in (*wrong, {})
    ]
    faults: list[str] = []
    records = run_many(asked, results=store, on_fault=lambda spec, error: faults.append(str(error)))
    assert [record.status for record in records] == ["ok"]
    assert len(faults) == len(wrong)


def _be_daemonic() -> None:
    """In a worker: be one that multiprocessing refuses children of its own."""
    multiprocessing.current_process()._config["daemon"] = True  # type: ignore[attr-defined]
    assert multiprocessing.current_process().daemon


def test_any_executor(tmp_path: Path, toy_folder: str, monkeypatch: pytest.MonkeyPatch) -> None:
    run_many(specs(toy_folder, range(1)), results=tmp_path / "here")
    monkeypatch.setenv(START_VARIABLE, "fresh")  # no fork server for one run of the worker
    executors = [
        ThreadPoolExecutor(2),
        ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _be_daemonic),
    ]
    for number, executor in enumerate(executors):
        events: list = []
        with executor:
            there = run_many(
                specs(toy_folder, range(1)),
                results=tmp_path / f"there{number}",
                executor=executor,
                **follow(events),
            )
        assert kinds(events) == {"finished": 1, "started": 1}
        store = RunStore(tmp_path / f"there{number}")
        assert sorted(record.run_id for record in there) == store.ids()
        # the plug-in's process has loaded other modules here than there: another id, the same
        # result
        assert by_request(store) == by_request(RunStore(tmp_path / "here"))
        assert score(store, there[0], "evo-default").metrics["ate_rmse_m"] > 0


class _Dying(Executor):
    """An executor whose other end goes: before anything is handed over, or while it is made."""

    def __init__(self, error: Exception, *, at_once: bool) -> None:
        self.error = error
        self.at_once = at_once

    def submit(self, *_: object, **__: object) -> Future:
        if self.at_once:
            raise self.error
        future: Future = Future()
        future.set_exception(self.error)
        return future


@pytest.mark.parametrize("at_once", [True, False])
@pytest.mark.parametrize(
    "error", [CancelledError(), OSError("comm\nclosed"), RuntimeError("shutdown"), KeyError(1)]
)
def test_an_executor_that_dies_is_one_clear_line_and_no_outcome(
    tmp_path, toy_folder, error, at_once
) -> None:
    with pytest.raises(
        InfrastructureError, match=rf"^the executor gave up: {type(error).__name__}"
    ):
        run_many(
            specs(toy_folder, range(2)), results=tmp_path, executor=_Dying(error, at_once=at_once)
        )
    assert RunStore(tmp_path).ids() == []


def test_packed_runs_that_are_none(store: RunStore, toy_folder: str, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="5 bytes from a worker are no packed run"):
        unpack(b"bytes", store)
    record = run_one(specs(toy_folder, range(1))[0], store)
    good = pack(store, record)
    other = RunStore(tmp_path / "other")
    other.prepare()
    for name in (
        "../evil.txt",
        "/etc/evil",
        f"runs/{record.run_id}/../../evil.txt",
        "runs/zz/x.txt",
    ):
        buffer = io.BytesIO(good)
        with zipfile.ZipFile(buffer, "a") as archive:
            archive.writestr(name, "x")
        with pytest.raises(RunError, match="packed run holds"):
            unpack(buffer.getvalue(), other)
    assert other.ids() == []
    assert not list(tmp_path.rglob("evil*"))
    assert unpack(good, other) == record
    assert other.ids() == [record.run_id]


@pytest.mark.parametrize(
    "writes",
    ["dynslam_bench.runs.packing.TemporaryFolder", "zipfile.ZipFile.extractall"],
    ids=["worker", "head"],
)
def test_a_full_disk_of_a_worker_or_of_the_head_is_one_clear_line(
    tmp_path: Path, toy_folder: str, monkeypatch: pytest.MonkeyPatch, writes: str
) -> None:
    monkeypatch.setattr(writes, Mock(side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))))
    with (
        ThreadPoolExecutor(1) as executor,
        pytest.raises(InfrastructureError, match=r"No space left"),
    ):
        run_many(specs(toy_folder, range(1)), results=tmp_path, executor=executor)
    assert RunStore(tmp_path).ids() == []


# -- imported trajectories -------------------------------------------------------------------------


def write_estimate(path: Path, shift_s: float = 0.0, every: int = 1) -> Path:
    stamps = 100.0 + np.arange(0, 60, every) / 30.0 + shift_s
    poses = truth(60)[::every].copy()
    poses[:, 0, 3] += 0.01 * np.sin(np.arange(len(poses)))
    write_tum(path, Trajectory(stamps, poses))
    return path


def test_import(store: RunStore, toy_folder: str, tmp_path: Path) -> None:
    path = write_estimate(tmp_path / "theirs.txt", every=2)
    record = import_trajectory(path, "their-slam", toy_folder, results=store)
    assert (record.kind, record.tracker.label) == ("imported", "their-slam (imported)")
    metrics = score(store, record)
    assert metrics.trajectory == "final"
    assert metrics.online is None
    assert 0.001 < metrics.metrics["ate_rmse_m"] < 0.01
    assert metrics.primary.coverage == 0.5
    assert import_trajectory(path, "their-slam", toy_folder, results=store).run_id == record.run_id


@pytest.mark.parametrize(
    ("kept", "status"),
    [
        (slice(0, 8), "lost"),  # 13 %
        (slice(0, 60, 7), "lost"),  # 15 %, to the end
        # the last ten frames have none, as in a run that is lost at its end
        (slice(0, 50), "lost"),
        (slice(0, 51), "ok"),
        (slice(0, 60, 2), "ok"),
        (slice(30, 60), "ok"),
    ],
)
def test_an_import_is_lost_by_the_rule_of_runs(
    kept: slice, status: str, store: RunStore, toy_folder: str, tmp_path: Path
) -> None:
    whole = read_tum(write_estimate(tmp_path / "all.txt"))
    write_tum(tmp_path / "part.txt", whole.select(kept))
    record = import_trajectory(
        tmp_path / "part.txt", "their-slam", toy_folder, results=store, which="online"
    )
    assert (record.status, bool(record.reason)) == (status, status != "ok")
    assert record.n_tracked == len(whole.select(kept))
    assert record.coverage == pytest.approx(record.n_tracked / 60)


def test_import_with_stamps_of_its_own(store: RunStore, toy_folder: str, tmp_path: Path) -> None:
    path = write_estimate(tmp_path / "theirs.txt", shift_s=0.005)
    record = import_trajectory(path, "their-slam", toy_folder, results=store, which="online")
    assert not record.stamps_match
    assert record.coverage == 1.0
    assert record.notes == ["60 of 60 poses carry stamps that are no input frame's"]
    assert score(store, record).online.n_pairs == 60


def test_import_of_something_else(store: RunStore, toy_folder: str, tmp_path: Path) -> None:
    far = write_estimate(tmp_path / "far.txt", shift_s=1000.0)
    with pytest.raises(
        RunError, match=r"shares 0 stamps with .*, at least 2 are needed: the nearest is 998"
    ):
        import_trajectory(far, "x", toy_folder, results=store)
    with pytest.raises(DynslamError, match="cannot read"):
        import_trajectory(tmp_path / "none.txt", "x", toy_folder, results=store)
    with pytest.raises(RunError, match="name of its tracker"):
        import_trajectory(far, " ", toy_folder, results=store)
    assert store.ids() == []


@pytest.fixture
def jumps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eleven days forwards, then backwards, at every look at the clock."""
    away = cycle((1e6, -1e6))
    now = time.time
    monkeypatch.setattr(time, "time", lambda: now() + next(away))
    assert abs(time.time() - time.time()) > 1e6


@pytest.mark.usefixtures("jumps")
def test_runs_are_made_waited_for_and_kept(store: RunStore, toy_folder: str) -> None:
    specs = [
        RunSpec(tracker=TARGET, sequence=toy_folder, frames=(0, 8), seed=seed) for seed in range(2)
    ]
    pool = ThreadPoolExecutor(1)
    with store.work_folder("0" * 16) as work, store.claim(resolve(specs[0]).run_id) as mine:
        assert mine
        call = pool.submit(run_many, specs, results=store)
        until(store.ids)
        RunStore(store.root).prepare()  # sweeps what nobody holds
        assert work.is_dir()
        (run_id,) = store.ids()  # the other one is being made elsewhere
        assert run_id.startswith(resolve(specs[1]).request_digest)
    made = call.result(300)
    assert [record.status for record in made] == ["ok", "ok"]
    assert all(
        0 < record.wall_s < 900 and 0 < record.timings["total"].mean_s < 900 for record in made
    )


@pytest.mark.parametrize("name", suite_names())
def test_every_suite_names_only_what_exists(name: str) -> None:
    suite = load_suite(name)
    assert suite.title
    assert suite.description
    assert suite.name == name
    for sequence in suite.sequences:
        assert sequence.partition("?")[0] in sequence_ids() or entry_of(sequence) is not None
        if sequence.startswith("synthetic/"):
            assert parse_synthetic_id(sequence).split == "held-out", (
                "the embedded network was trained on the others"
            )
    specs = list(suite.specs())
    assert len(specs) == len({spec.model_dump_json() for spec in specs}) > 0


def test_dynamic_holds_every_ranked_system_on_three_scenes_of_the_eight_replicas() -> None:
    suite = load_suite("dynamic")
    assert (
        len({parse_synthetic_id(name).scene for name in suite.sequences})
        == len(suite.sequences)
        == 24
    )
    specs = [found.spec for found in TRACKERS.all() if "trackers.systems" in found.spec.entry_point]
    composed = {spec.id for spec in specs if spec.sensors == "rgbd"}
    ablations = {
        name for name in composed if not TRACKERS.get(name).ranked and name.startswith("emfoa-oft")
    }
    assert composed - ablations <= set(suite.trackers)
    assert load_suite("dynamic-full").trackers == suite.trackers
    objects = load_suite("objects")
    # that one takes half a second a frame
    assert set(suite.trackers) - {"emfoa-oft-paper"} < set(objects.trackers)
    assert objects.settings == {"segmentation.source": "oracle-classes"}


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_a_users_suite_makes_all_combinations_with_their_settings(tmp_path: Path) -> None:
    path = write(
        tmp_path / "mine.toml",
        """
        trackers = ["never-move", "orb-slam2"]
        sequences = ["synthetic/walking_xyz"]
        seeds = [0, 1]
        frames = [0, 20]
        [settings]
        "features.n_features" = 500
        [tracker_settings.orb-slam2]
        "guard.min_features" = 30
        [[variants]]
        [[variants]]
        name = "blur"
        degrade = { blur = 0.5 }
        """,
    )
    specs = list(load_suite(path).specs(data_root="/data", device="cpu", threads=2))
    # 2 trackers x 2 seeds x 2 variants, the first unchanged
    assert len(specs) == 8
    assert {spec.threads for spec in specs} == {2}
    assert {spec.data_root for spec in specs} == {"/data"}
    assert [spec.degrade for spec in specs] == [{}] * 4 + [{"blur": 0.5}] * 4
    orb = next(spec for spec in specs if spec.tracker == "orb-slam2")
    assert (orb.settings["guard.min_features"], orb.settings["features.n_features"]) == (30, 500)
    assert all(spec.settings == {} for spec in specs if spec.tracker == "never-move")


def test_offsets_of_a_suite_are_repeats_beside_the_seeds(tmp_path: Path) -> None:
    text = 'trackers = ["never-move"]\nsequences = ["synthetic/walking_xyz"]\nseeds = [0, 1]\noffsets = [0, 3]\n'
    suite = load_suite(write(tmp_path / "mine.toml", text))
    assert [(spec.seed, spec.offset) for spec in suite.specs()] == [(0, 0), (0, 3), (1, 0), (1, 3)]
    assert [spec.offset for spec in suite.specs(seeds=(0,), offsets=(5,))] == [5]
    with pytest.raises(
        DynslamError, match=r"offsets\.0: input should be greater than or equal to 0"
    ):
        load_suite(write(tmp_path / "bad.toml", text.replace("[0, 3]", "[-1]")))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("trackers = [", "not valid TOML"),
        ('trackers = ["never-move"]', "sequences: field required"),
        ('trackers = []\nsequences = ["a/b"]', "trackers"),
        (
            'trackers = ["never-mov"]\nsequences = ["a/b"]',
            "unknown tracker 'never-mov'.*never-move",
        ),
        ('trackers = ["never-move"]\nsequences = ["a/b"]\nseed = [1]', "unknown key 'seed'.*seeds"),
    ],
)
def test_bad_suites(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DynslamError, match=message):
        load_suite(write(tmp_path / "bad.toml", text))


def test_frames_of_a_run_are_read_however_they_are_written() -> None:
    ways = [(0, 30), [0, 30], "0:30", ":30"]
    assert {RunSpec(tracker="x", sequence="y", frames=way).frames for way in ways} == {(0, 30)}
    assert {
        RunSpec(tracker="x", sequence="y", frames=way).frames
        for way in (None, ":", "0:", (0, None))
    } == {None}
    with pytest.raises(DynslamError, match=r"5:2"):
        RunSpec(tracker="x", sequence="y", frames="5:2")


def test_rows_are_of_trackers_of_the_suite(tmp_path: Path) -> None:
    text = 'trackers = ["never-move"]\nsequences = ["synthetic/walking_xyz"]\n[[rows]]\ntracker = "{}"\nsettings = {}'
    stranger = write(tmp_path / "a.toml", text.format("orb-slam2", '{ "guard.min_features" = 30 }'))
    common = 'trackers = ["orb-slam2"]\nsequences = ["synthetic/sitting_xyz"]\n[settings]\n"features.levls" = 4\n'
    with pytest.raises(
        RunError, match=r"'features\.levls', which none of its trackers has.*features\.levels"
    ):
        load_suite(write(tmp_path / "c.toml", common)).specs()
    with pytest.raises(RunError, match="'orb-slam2', which is none of its trackers"):
        load_suite(stranger).specs()
    with pytest.raises(RunError, match=r"rows\.0\.settings"):
        load_suite(write(tmp_path / "b.toml", text.format("never-move", "{}")))


# A real Dask cluster: runs come back as bytes, and its end is one clear line. Skipped without
# `distributed`.


class Cluster:
    """A Dask scheduler and its workers, each a process of one thread."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.place = folder / "scheduler.json"
        self.workers = []
        self.scheduler = self.start("dask_scheduler", "--host", "127.0.0.1", "--port", "0")
        until(
            lambda: (
                self.scheduler.poll() is not None
                or (self.place.is_file() and self.place.read_text())
            ),
            300,
        )
        assert self.scheduler.poll() is None
        self.address = json.loads(self.place.read_text())["address"]

    def start(self, program: str, *arguments: str, **environment: str) -> subprocess.Popen:
        command = [
            sys.executable,
            "-m",
            f"distributed.cli.{program}",
            "--scheduler-file",
            str(self.place),
            *arguments,
        ]
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        return subprocess.Popen(
            [*command, "--no-dashboard"], env=os.environ | environment, **silent
        )

    def add(self, **environment: str) -> subprocess.Popen:
        """A worker on a host of its own, with these variables of the environment."""
        host = ("--host", f"127.0.0.{len(self.workers) + 2}") if sys.platform == "linux" else ()
        private = (*host, "--nthreads", "1", "--no-nanny", "--local-directory", str(self.folder))
        self.workers.append(self.start("dask_worker", *private, **environment))
        return self.workers[-1]


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    pytest.importorskip("distributed")
    monkeypatch.setenv("PYTHONPATH", ":".join(path for path in sys.path if path))
    monkeypatch.setenv(START_VARIABLE, "fresh")  # no fork server for few runs in a worker
    started = Cluster(tmp_path)
    yield started
    for process in (*started.workers, started.scheduler):
        process.kill()
        process.wait()


def test_a_scheduler_that_is_killed_in_the_middle_is_one_clear_line(
    tmp_path: Path, toy_folder: str, cluster: Cluster, capfd: pytest.CaptureFixture[str]
) -> None:
    store = RunStore(tmp_path / "results")
    executor = DaskWorkers(cluster.address)
    cluster.add()

    def told(event: RunEvent) -> None:
        if event.kind == "finished":
            cluster.scheduler.kill()

    asked = specs(toy_folder, range(9))
    with pytest.raises(InfrastructureError, match=r"^the executor gave up: CancelledError"):
        run_many(asked, results=store, executor=executor, on_event=told)
    assert "Traceback" not in capfd.readouterr().err
    records, unreadable = store.all()
    # what came back stays
    assert 1 <= len(records) < len(asked)
    assert unreadable == []
    assert {record.status for record in records} == {"ok"}


@pytest.mark.skipif(sys.platform != "linux", reason="a host for each worker")
def test_runs_are_made_by_the_workers_that_can_make_them(
    tmp_path: Path, cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = write_folder(tmp_path / "data" / "rgbd_dataset_freiburg1_xyz", 8)
    (tmp_path / "none").mkdir()
    for name, more in (("same", ""), ("other", "\n\ndef more() -> int:\n    return 1\n")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "toy_of_mine.py").write_text(Path(envs_toys.__file__).read_text() + more)
    monkeypatch.syspath_prepend(tmp_path / "same")
    monkeypatch.setenv("DYNSLAM_BENCH_DATA", str(data.parent))
    path = os.environ["PYTHONPATH"]
    same, other = ({"PYTHONPATH": f"{tmp_path / name}:{path}"} for name in ("same", "other"))
    cluster.add(**same)
    victim = cluster.add(**same)
    cluster.add(**other)
    cluster.add(**same, DYNSLAM_BENCH_DATA=str(tmp_path / "none"))
    (tmp_path / "fake" / "dynslam_bench").mkdir(parents=True)
    # an editable installation would find the modules of an empty package
    (tmp_path / "fake" / "dynslam_bench" / "__init__.py").write_text("raise ImportError")
    cluster.add(PYTHONPATH=f"{tmp_path}/fake:{path}")

    def told(event: RunEvent) -> None:
        if event.kind == "finished":
            victim.kill()

    asked = [
        RunSpec(
            tracker="toy_of_mine:SPEC",
            sequence="tum/fr1/xyz",
            camera=str(data / "camera.toml"),
            seed=seed,
        )
        for seed in range(6)
    ]
    here = RunStore(tmp_path / "here")
    there = RunStore(tmp_path / "there")
    with DaskWorkers(cluster.address) as executor:
        executor._client.wait_for_workers(5)
        rows = executor.describe(["tum/fr1/xyz"])
        assert sorted(str(row["lacks"]) for row in rows) == [
            "['tum/fr1/xyz']",
            "[]",
            "[]",
            "[]",
            "[]",
        ]
        assert sorted(str(row["code"]) for row in rows) == ["none", *["the same"] * 4]
        records = run_many(asked, results=there, executor=executor, on_event=told)
        (refusals,) = executor._refused.values()
    assert [record.status for record in records] == ["ok"] * len(asked)
    reasons = sorted(str(reason) for reason in refusals.values())
    assert len(reasons) == 2
    assert "is not at" in reasons[0]
    assert "plug-ins differ" in reasons[1]
    monkeypatch.delenv(START_VARIABLE)  # here the fork server of other tests makes them
    run_many(asked, results=here)
    assert by_request(here) == by_request(there)


def test_a_suite_on_a_scheduler_begins_with_what_its_workers_have(
    tmp_path: Path, toy_folder: str, cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    suite = write(
        tmp_path / "toys.toml",
        f'trackers = ["{TARGET}"]\nsequences = ["{toy_folder}"]\nframes = [0, 8]\n',
    )
    cluster.add()
    with DaskWorkers(cluster.address) as executor:
        executor._client.wait_for_workers(1)
    (run,) = bench(
        suite, results=tmp_path / "results", scheduler=cluster.address, on_workers=show_workers
    )
    heading, row = capsys.readouterr().err.splitlines()[:2]
    assert heading.startswith("worker ")
    assert "the same" in row
    assert run.record.status == "ok"
    with pytest.raises(RunError, match="no Dask scheduler answers at nowhere:1"):
        bench(suite, results=tmp_path / "results", scheduler="nowhere:1")


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory, toy_folder: str) -> list[RunStore]:
    """The two shards of a suite of five runs, and the whole."""
    folder = tmp_path_factory.mktemp("shards")
    toys = f'trackers = ["{TARGET}"]\nsequences = ["{toy_folder}"]\nframes = [0, 8]\nseeds = [0, 1, 2, 3, 4]\n'
    suite = write(folder / "toys.toml", toys)
    stores = {
        "1/2": RunStore(folder / "shard1"),
        "2/2": RunStore(folder / "shard2"),
        "1/1": RunStore(folder / "whole"),
    }
    for shard, store in stores.items():
        bench(suite, results=store.root, shard=parse_shard(shard))
    assert bench(suite, results=folder / "none", shard=(6, 6)) == []
    assert not (folder / "none").exists()
    return list(stores.values())


def by_request(store: RunStore) -> dict[str, bytes]:
    """The results by what was asked for: what a plug-in's process has loaded, and so the id, is another on a worker."""
    return {run_id[:12]: trajectory for run_id, trajectory in outcomes(store).items()}


def outcomes(store: RunStore) -> dict[str, bytes]:
    return {
        run_id: (store.folder(run_id) / "trajectory_online.txt").read_bytes()
        for run_id in store.ids()
    }


def test_merged_shards_are_the_suite(shards: list[RunStore], tmp_path: Path) -> None:
    *parts, whole = shards
    assert [len(part.ids()) for part in parts] == [3, 2]
    target = RunStore(tmp_path / "all")
    assert (sorted(merge(parts, target).added), outcomes(target)) == (whole.ids(), outcomes(whole))
    again = merge(shards, target)
    assert (again.added, len(again.stored), again.left_out) == ([], 10, [])


def test_a_shard_is_merged_and_read_as_one_file(shards: list[RunStore], tmp_path: Path) -> None:
    parts = shards[:2]
    with tarfile.open(tmp_path / "shard1.tgz", "w:gz") as archive:
        for name in ("runs", "sequences"):
            archive.add(parts[0].root / name, name)
    shutil.make_archive(str(tmp_path / "shard2"), "zip", parts[1].root.parent, "shard2")
    files = [tmp_path / "shard1.tgz", tmp_path / "shard2.zip"]
    target = RunStore(tmp_path / "all")
    assert len(merge(map(open_store, files), target).added) == 5
    frame = pd.concat([open_store(file).frame() for file in files]).sort_values(
        "started", ignore_index=True
    )
    pd.testing.assert_frame_equal(frame, target.frame())
    assert len(load_frame(files)) == 5
    with pytest.raises(RunError, match=r"shard1.tgz is an archive.*-o"):
        report(files)
    one = parts[0].ids()[0]
    with pytest.raises(RunError, match=r"shard1.tgz is an archive.*-o"):
        export_run(one, "tum", results=files[0])
    assert (
        export_run(one, "tum", tmp_path / "tum", results=files[0]).folder / "provenance.json"
    ).is_file()
    contradicted = files[1].rename(tmp_path / "other.zip")
    trajectory = target.folder(parts[1].ids()[0]) / "trajectory_online.txt"
    trajectory.write_text("")
    ((path, _),) = map(astuple, merge([open_store(contradicted)], target).left_out)
    assert {"other.zip", trajectory.parent.name} <= set(path.parts)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("runs/../../x", "outside"), ("latest", "a link"), ("other/x", "there are no runs in"),
        ("shard1/runs/x", "holds 2 results folders"),
    ],
)  # fmt: skip
def test_an_archive_that_is_no_results_folder_is_refused(
    tmp_path: Path, name: str, reason: str
) -> None:
    with tarfile.open(tmp_path / "shard.tar", "w") as archive:
        entry = tarfile.TarInfo(name)
        entry.type = tarfile.SYMTYPE if name == "latest" else tarfile.REGTYPE
        archive.addfile(entry)
        if name.startswith("shard1"):
            archive.addfile(tarfile.TarInfo("shard2/runs/x"))
    with pytest.raises(DynslamError, match=reason):
        open_store(tmp_path / "shard.tar")


@pytest.mark.parametrize("text", ["0/2", "3/2", "1", "1/0", "-1/2", "1/2/3"])
def test_a_shard_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(RunError, match="write K/N"):
        parse_shard(text)


def test_what_contradicts_the_store_is_named_and_left_out(tmp_path: Path, toy_folder: str) -> None:
    stores = [
        RunStore(tmp_path / name) for name in ("one", "other", "damaged", "truth", "lost", "linked")
    ]
    spec = RunSpec(tracker=TARGET, sequence=toy_folder, frames=(0, 8))
    for store in stores:
        (record,) = run_many([spec], results=store)
    one, other, damaged, truth, lost, linked = (store.folder(record.run_id) for store in stores)
    trajectory = other / "trajectory_online.txt"
    trajectory.write_text(trajectory.read_text().replace("0.1", "0.2"))
    (damaged / "run.json").write_text("{")
    (stores[3].root / "sequences" / record.sequence.part / "groundtruth.txt").write_text(
        "0 0 0 0 0 0 0 1\n"
    )
    (stores[4].root / "sequences" / record.sequence.part / "timestamps.txt").unlink()
    (stores[5].root / "sequences" / record.sequence.part / "more.txt").symlink_to(__file__)
    before = outcomes(stores[0])
    merged = merge(stores[1:], stores[0])
    assert [entry.path for entry in merged.left_out] == [other, damaged, truth, lost, linked]
    assert "a link that leads out" in merged.left_out[4].reason
    assert not list(stores[0].root.rglob("more.txt"))
    assert "another result" in merged.left_out[0].reason
    assert "stamps or truth" in merged.left_out[2].reason
    assert (merged.added, merged.stored, outcomes(stores[0])) == ([], [], before)
    assert one.is_dir()
    for store in (stores[1], stores[3]):  # made again, and put back
        assert store.changed(record)
        assert not store.changed(*run_many([spec], results=store))


class OtherWorkers(ThreadPoolExecutor):
    """Workers of which some lack the sequence, or have other code."""

    def __init__(self, spec_changes: dict, identity_changes: dict) -> None:
        super().__init__(1)
        self.changes = spec_changes, identity_changes

    def submit(self, fn, spec: str, protocol: str, identity: str) -> Future:
        texts = [spec, identity]
        if json.loads(spec)["seed"] == 1:
            texts = [
                json.dumps(json.loads(text) | new)
                for text, new in zip(texts, self.changes, strict=True)
            ]
        return super().submit(fn, texts[0], protocol, texts[1])


@pytest.mark.parametrize(
    ("spec_changes", "identity_changes", "reason"),
    [
        ({"sequence": "/nowhere"}, {}, r"worker \S+ cannot make the run: .*/nowhere"),
        ({}, {"source": "x"}, "source differ"),
    ],
)
def test_a_worker_that_is_not_like_this_machine_stops_no_other_run(
    tmp_path: Path, toy_folder: str, spec_changes: dict, identity_changes: dict, reason: str
) -> None:
    specs = [
        RunSpec(tracker=TARGET, sequence=toy_folder, frames=(0, 8), seed=seed) for seed in range(3)
    ]
    faults: list[tuple[int, DynslamError]] = []
    with OtherWorkers(spec_changes, identity_changes) as executor:
        records = run_many(
            specs,
            results=tmp_path,
            executor=executor,
            on_fault=lambda spec, error: faults.append((spec.seed, error)),
        )
    assert [record.seed for record in records] == [0, 2]
    ((seed, fault),) = faults
    assert seed == 1
    with pytest.raises(RunError, match=reason):
        raise fault


def test_what_many_runs_share_is_looked_up_once(toy_folder: str) -> None:
    specs = [
        RunSpec(
            tracker=TARGET,
            sequence=toy_folder,
            frames=(0, stop),
            offset=offset,
            seed=seed,
            threads=threads,
        )
        for stop, offset, seed, threads in [(8, 0, 0, 1), (8, 0, 1, 1), (9, 0, 0, 1), (8, 1, 0, 2)]
    ]
    look_up = Resolver()
    together = [look_up(spec) for spec in specs]
    assert [run.run_id for run in together] == [resolve(spec).run_id for spec in specs]
    assert together[0].sequence is together[1].sequence
    assert together[0].settings is together[3].settings
    assert len({run.run_id for run in together}) == 4
