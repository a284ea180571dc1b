"""Parts of a suite on several machines: shards, stores that are merged, and workers that are not like this machine."""

import json
import shutil
import tarfile
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import astuple
from pathlib import Path

import pandas as pd
import pytest
from envs_toys import TARGET

from dynslam_bench.api import bench
from dynslam_bench.cli.running import parse_shard
from dynslam_bench.core.errors import DynslamError, RunError
from dynslam_bench.reports import load_frame
from dynslam_bench.runs import RunSpec, RunStore, merge, open_store, resolve, run_many
from dynslam_bench.runs.identity import Resolver


@pytest.fixture
def suite(tmp_path: Path, toy_folder: str) -> Path:
    path = tmp_path / "toys.toml"
    path.write_text(
        f'trackers = ["{TARGET}"]\nsequences = ["{toy_folder}"]\nframes = [0, 8]\nseeds = [0, 1, 2, 3, 4]\n'
    )
    return path


def outcomes(store: RunStore) -> dict[str, bytes]:
    return {run_id: (store.folder(run_id) / "trajectory_online.txt").read_bytes() for run_id in store.ids()}


def test_merged_shards_are_the_suite(suite: Path, tmp_path: Path) -> None:
    whole, parts = RunStore(tmp_path / "whole"), [RunStore(tmp_path / f"shard{k}") for k in (1, 2)]
    bench(suite, results=whole.root)
    for k, part in enumerate(parts, 1):
        bench(suite, results=part.root, shard=parse_shard(f"{k}/2"))
    assert [len(part.ids()) for part in parts] == [3, 2]
    target = RunStore(tmp_path / "all")
    assert sorted(merge(parts, target).added) == whole.ids()
    assert outcomes(target) == outcomes(whole)
    again = merge([*parts, whole], target)
    assert (again.added, len(again.stored), again.left_out) == ([], 10, [])
    assert bench(suite, results=tmp_path / "none", shard=(6, 6)) == [] and not (tmp_path / "none").exists()


def test_a_shard_is_merged_and_read_as_one_file(suite: Path, tmp_path: Path) -> None:
    parts = [RunStore(tmp_path / f"shard{k}") for k in (1, 2)]
    for k, part in enumerate(parts, 1):
        bench(suite, results=part.root, shard=(k, 2))
    with tarfile.open(tmp_path / "shard1.tgz", "w:gz") as archive:
        for name in ("runs", "sequences"):
            archive.add(parts[0].root / name, name)
    shutil.make_archive(str(parts[1].root), "zip", tmp_path, "shard2")
    files, target = [tmp_path / "shard1.tgz", tmp_path / "shard2.zip"], RunStore(tmp_path / "all")
    assert len(merge(map(open_store, files), target).added) == 5
    assert outcomes(target) == outcomes(parts[0]) | outcomes(parts[1])
    frame = pd.concat([open_store(file).frame() for file in files]).sort_values("started", ignore_index=True)
    pd.testing.assert_frame_equal(frame, target.frame())
    assert len(load_frame(files)) == 5
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
def test_an_archive_that_is_no_results_folder_is_refused(tmp_path: Path, name: str, reason: str) -> None:
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
    stores = [RunStore(tmp_path / name) for name in ("one", "other", "damaged", "truth", "lost")]
    spec = RunSpec(tracker=TARGET, sequence=toy_folder, frames=(0, 8))
    for store in stores:
        (record,) = run_many([spec], results=store)
    one, other, damaged, truth, lost = (store.folder(record.run_id) for store in stores)
    trajectory = other / "trajectory_online.txt"
    trajectory.write_text(trajectory.read_text().replace("0.1", "0.2"))
    (damaged / "run.json").write_text("{")
    (stores[3].root / "sequences" / record.sequence.part / "groundtruth.txt").write_text("0 0 0 0 0 0 0 1\n")
    (stores[4].root / "sequences" / record.sequence.part / "timestamps.txt").unlink()
    before = outcomes(stores[0])
    merged = merge(stores[1:], stores[0])
    assert [entry.path for entry in merged.left_out] == [other, damaged, truth, lost]
    assert "another result" in merged.left_out[0].reason and "stamps or truth" in merged.left_out[2].reason
    assert (merged.added, merged.stored, outcomes(stores[0])) == ([], [], before) and one.is_dir()


class OtherWorkers(ThreadPoolExecutor):
    """Workers of which some lack the sequence, or have other code."""

    def __init__(self, spec_changes: dict, identity_changes: dict) -> None:
        super().__init__(1)
        self.changes = spec_changes, identity_changes

    def submit(self, fn, spec: str, protocol: str, identity: str) -> Future:
        texts = [spec, identity]
        if json.loads(spec)["seed"] == 1:
            texts = [json.dumps(json.loads(text) | new) for text, new in zip(texts, self.changes, strict=True)]
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
    specs = [RunSpec(tracker=TARGET, sequence=toy_folder, frames=(0, 8), seed=seed) for seed in range(3)]
    faults: list[tuple[int, DynslamError]] = []
    with OtherWorkers(spec_changes, identity_changes) as executor:
        records = run_many(
            specs, results=tmp_path, executor=executor, on_fault=lambda spec, error: faults.append((spec.seed, error))
        )
    assert [record.seed for record in records] == [0, 2]
    ((seed, fault),) = faults
    assert seed == 1
    with pytest.raises(RunError, match=reason):
        raise fault


def test_a_link_out_of_a_store_is_not_followed(tmp_path: Path, toy_folder: str) -> None:
    source, secret = RunStore(tmp_path / "source"), tmp_path / "secret.txt"
    (record,) = run_many([RunSpec(tracker=TARGET, sequence=toy_folder, frames=(0, 8))], results=source)
    secret.write_text("secret")
    (source.root / "sequences" / record.sequence.part / "more.txt").symlink_to(secret)
    merged = merge([source], RunStore(tmp_path / "all"))
    assert merged.added == [] and "a link that leads out" in merged.left_out[0].reason
    assert not list((tmp_path / "all").rglob("more.txt"))


def test_what_many_runs_share_is_looked_up_once(toy_folder: str) -> None:
    specs = [
        RunSpec(tracker=TARGET, sequence=toy_folder, frames=(0, stop), offset=offset, seed=seed, threads=threads)
        for stop, offset, seed, threads in [(8, 0, 0, 1), (8, 0, 1, 1), (9, 0, 0, 1), (8, 1, 0, 2)]
    ]
    look_up = Resolver()
    together = [look_up(spec) for spec in specs]
    assert [run.run_id for run in together] == [resolve(spec).run_id for spec in specs]
    assert together[0].sequence is together[1].sequence and together[0].settings is together[3].settings
    assert len({run.run_id for run in together}) == 4
