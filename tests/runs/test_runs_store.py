"""The store: identity, listing, damaged folders, what killed processes leave, and faults at every operation."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from envs_toys import TARGET
from faults import in_a_small_process, survey, tree

from dynslam_bench.core.errors import DynslamError, RunError
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.runs import RunRecord, RunSpec, RunStore, resolve, run_one, score
from dynslam_bench.runs.store import RUN_FILE

HERE = Path(__file__).parent


def test_run_id_depends_on_what_matters_and_on_nothing_else(toy_folder: str, tmp_path: Path) -> None:
    base = {"tracker": TARGET, "sequence": toy_folder}
    first = resolve(RunSpec(**base)).run_id
    assert len(first) == 16 and resolve(RunSpec(**base)).run_id == first
    same = [
        {"settings": {"noise.clip": "2.0"}},
        {"settings": {"noise.clip": 2}},
        {"limits": {"time_s": 5}},
        {"video": True},
        {"sheet": True},
        {"degrade": {"blur": 0.0}},
        {"data_root": str(tmp_path)},
        {"frames": "0:60"},
        {"frames": (0, 900)},
        {"offset": 0},
    ]
    assert {resolve(RunSpec(**(base | change))).run_id for change in same} == {first}
    other = [
        {"seed": 1},
        {"settings": {"noise.clip": 2.5}},
        {"frames": (0, 30)},
        {"stride": 2},
        {"threads": 2},
        {"degrade": {"blur": 0.1}},
        {"drop_share": 0.1},
        {"realtime": True},
        {"offset": 3},
        {"frames": (3, None)},
        {"tracker": TARGET.replace(":SPEC", ":FIXED")},
    ]
    ids = [resolve(RunSpec(**(base | change))).run_id for change in other]
    assert len({first, *ids}) == len(ids) + 1


def test_a_part_has_one_run_id_however_it_is_written() -> None:
    def ids(sequence: str, **change) -> str:
        return resolve(RunSpec(tracker="never-move", sequence=f"synthetic/walking_xyz{sequence}", **change)).run_id

    first = ids("", frames="0:60")
    assert ids("?frames=60") == ids("?scene=0&frames=60") == ids("?frames=90", frames=":60")
    assert ids("@0?frames=60") == ids("?scene=000", frames=(0, 60)) == first
    assert ids("?frames=60") == first != ids("?frames=61")
    assert len({first, ids("?frames=60&noise=1"), ids("?frames=60&noise=2"), ids("?frames=60", offset=1)}) == 4


def test_an_edited_plug_in_that_a_setting_names_is_another_run(
    toy_folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    specs = {
        "features.extractor": "from dynslam_bench.features.registry import FeatureSpec as Spec",
        "flow.plugin": "from dynslam_bench.flow.registry import FlowSpec as Spec",
        "segmentation.source": "from dynslam_bench.segmentation.build_segmenter import SegmenterSpec as Spec",
    }
    for name, text in specs.items():
        plugin = tmp_path / name / "mine.py"
        plugin.parent.mkdir()
        plugin.write_text(f'{text}\n\nSPEC = Spec("mine", f"{{__file__}}:build")\n')
        value = f"plugin:{plugin}:SPEC" if name == "segmentation.source" else f"{plugin}:SPEC"
        spec = RunSpec(
            tracker="emfoa-oft", sequence=toy_folder, settings={"segmentation.source": "embedded", name: value}
        )
        before = resolve(spec).run_id
        (tmp_path / name / "readme.txt").write_text("not code")
        assert resolve(spec).run_id == before
        plugin.write_text(plugin.read_text() + "EDITED = True\n")
        assert resolve(spec).run_id != before, name


def test_changed_weights_are_another_run(toy_folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "dynslam_bench.segmentation.build_segmenter._check_network", lambda *_: None
    )  # any file will do
    weights = tmp_path / "net.onnx"
    weights.write_bytes(b"one")
    spec = RunSpec(tracker="mask-rcnn", sequence=toy_folder, settings={"segmentation.source": f"onnx:{weights}"})
    before = resolve(spec)
    weights.write_bytes(b"three")
    assert list(before.identity["weights"]) == ["segmentation.source"]
    assert resolve(spec).run_id != before.run_id


def test_listing_finding_and_removing(store: RunStore, toy_folder: str) -> None:
    first, second = (
        run_one(RunSpec(tracker=TARGET, sequence=toy_folder, frames=(0, 5), seed=s), store) for s in (0, 1)
    )
    score(store, first)
    records, unreadable = store.all()
    assert [record.run_id for record in records] == [first.run_id, second.run_id] and not unreadable
    assert store.find(first.run_id[:10]) == first.run_id and store.find("latest") == second.run_id
    assert store.read("latest") == second
    with pytest.raises(RunError, match="no run 'zzzz'"):
        store.find("zzzz")
    with pytest.raises(RunError, match=r"2 runs begin|no run ''"):
        store.find("")
    store.remove(first.run_id[:12])
    assert store.ids() == [second.run_id] and store.index.names() == set()
    store.remove("latest")
    assert store.ids() == [] and not (store.root / "latest").is_symlink()
    with pytest.raises(RunError, match="there are no runs in"):
        store.read("latest")


def test_a_newer_record_is_refused_not_misread(tmp_path: Path) -> None:
    text = (HERE / "data" / "run.json").read_text()
    newer = {'"coverage_new"': '"coverage"', 'schema_version": 99': 'schema_version": 1'}
    for (new, old), words in zip(newer.items(), ("coverage_new", "a newer dynslam-bench"), strict=True):
        (tmp_path / "run.json").write_text(text.replace(old, new, 1))
        with pytest.raises(DynslamError, match=words):
            RunRecord.read(tmp_path / "run.json")


def test_what_a_killed_process_left_is_swept_up_and_nothing_else(tmp_path: Path) -> None:
    root = tmp_path / "results"
    code = (
        f"import os, sys; sys.path[:0] = {sys.path!r}\n"
        "from dynslam_bench.runs import RunStore\n"
        f"store = RunStore({str(root)!r}); store.prepare()\n"
        f"with store.work_folder({'a' * 16!r}) as work, store.claim({'a' * 16!r}) as mine:\n"
        "    assert mine; os.kill(os.getpid(), 9)\n"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == -signal.SIGKILL
    runs = root / "runs"
    assert len(list(runs.iterdir())) == 2
    (runs / ".git").mkdir()
    store = RunStore(root)
    with store.work_folder("b" * 16) as alive, store.claim("b" * 16) as mine:
        assert mine
        RunStore(root).prepare()
        assert {path.name for path in runs.iterdir()} == {alive.name, f".{'b' * 16}.claim", ".git"}
    assert {path.name for path in runs.iterdir()} == {".git"}


RECORD = RunRecord.read(Path(__file__).parent / "data" / "run.json")
FAILED = RECORD.model_copy(update={"status": "crashed", "reason": "an earlier try"})
TRUTH = Trajectory(np.arange(5.0), np.tile(np.eye(4), (5, 1, 1)))


def make(root: Path, record: RunRecord) -> None:
    """What a run writes into the store."""
    store = RunStore(root)
    store.prepare()
    with store.claim(record.run_id), store.work_folder(record.run_id) as work:
        store.add_sequence(record.sequence.part, TRUTH.timestamps_ns, TRUTH)
        store.publish(work, record)


def held(root: Path) -> dict[str, bytes | str]:
    """What is in the store once the next command has swept it, a minute later."""
    for new in root.rglob(".*.new"):
        os.utime(new, (0, 0))
    RunStore(root).prepare()
    return tree(root)


@in_a_small_process
def test_a_new_run_is_there_whole_or_not_at_all(tmp_path: Path) -> None:
    root = tmp_path / "results"

    def whole_or_missing() -> None:
        records, unreadable = RunStore(root).all()
        assert records in ([], [RECORD]) and unreadable == []

    found = survey(lambda: make(root, RECORD), root, halfway=whole_or_missing, result=lambda: held(root))
    assert {name.split("/")[0] for name in tree(root)} == {"runs", "sequences", "latest"}
    assert found.operations > 20 and found.ends["kill", -9] == found.operations
    assert found.ends["full", 3] > 5 and found.ends["read-only", 3] > 5 and found.ends.total() == 4 * found.operations


@in_a_small_process
def test_a_run_that_is_made_again_is_never_lost(tmp_path: Path) -> None:
    root = tmp_path / "results"

    def old_or_new() -> None:
        store = RunStore(root)
        (record,) = store.all()[0]
        assert record in (FAILED, RECORD)

    found = survey(
        lambda: make(root, RECORD),
        root,
        begin=lambda: make(root, FAILED),
        halfway=old_or_new,
        result=lambda: held(root),
        faults=("kill",),
    )
    assert found.operations > 15 and found.ends["kill", -9] == found.operations


@in_a_small_process
def test_a_run_is_removed_or_still_there(tmp_path: Path) -> None:
    root = tmp_path / "results"

    def remove() -> None:
        store = RunStore(root)
        if store.ids():
            store.remove(RECORD.run_id)

    found = survey(
        remove, root, begin=lambda: make(root, RECORD), result=lambda: held(root).keys(), faults=("kill", "full")
    )
    assert not RunStore(root).ids() and found.operations > 5 and found.ends["kill", -9] == found.operations


def test_four_publish_the_same_run(tmp_path: Path) -> None:
    """No false error, no missing file, nothing left over: an existing run is no failure."""
    store = RunStore(tmp_path)
    store.prepare()

    def publish(_: int) -> RunRecord:
        with store.work_folder(RECORD.run_id) as work:
            (work / "trajectory_online.txt").write_text("0 0 0 0 0 0 0 1\n")
            return store.publish(work, RECORD)

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(publish, range(100))) == [RECORD] * 100
    assert {path.name for path in store.runs.iterdir()} == {RECORD.run_id}
    assert {path.name for path in store.folder(RECORD.run_id).iterdir()} == {RUN_FILE, "trajectory_online.txt"}
