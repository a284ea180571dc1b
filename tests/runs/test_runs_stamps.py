"""A run keeps its frames' stamps to the nanosecond, and refuses before tracking what cannot be told apart."""

from __future__ import annotations

from pathlib import Path

import pytest
from envs_toys import TARGET, ToySequence, write_folder

from dynslam_bench.core.errors import DynslamError, SequenceError
from dynslam_bench.envs import SlamEnv
from dynslam_bench.geometry.stamps import format_ns, from_seconds
from dynslam_bench.runs import RunSpec, RunStore, resolve, run_many, run_one, score

START = 1403636579763555584
STEP = 33_333_337
FRAMES = 8


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A toy sequence with the stamps of a bag."""
    folder = write_folder(tmp_path / "toy", FRAMES)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        lines = [line.partition(" ")[2] for line in (folder / name).read_text().splitlines()]
        stamped = [f"{text} {rest}\n" for text, rest in zip(stamps(), lines, strict=True)]
        (folder / name).write_text("".join(stamped))
    return folder


def stamps() -> list[str]:
    return [format_ns(START + STEP * index) for index in range(FRAMES)]


def column(path: Path, separator: str = " ") -> list[str]:
    return [line.split(separator)[0] for line in path.read_text().splitlines() if not line.startswith(("#", "index"))]


def test_every_file_of_a_run_has_the_frames_own_stamps(store: RunStore, folder: Path) -> None:
    record = run_one(RunSpec(tracker=TARGET, sequence=str(folder)), store)
    made, part = store.folder(record.run_id), store.root / "sequences" / record.sequence.part
    for path in (
        made / "trajectory_online.txt",
        made / "trajectory_final.txt",
        part / "timestamps.txt",
        part / "groundtruth.txt",
    ):
        assert column(path) == stamps(), path.name
    assert [line.split(",")[1] for line in (made / "frames.csv").read_text().splitlines()[1:]] == stamps()
    assert record.status == "ok" and score(store, record).metrics["ate_rmse_m"] > 0


def test_a_part_of_a_sequence_has_the_stamps_of_its_frames(folder: Path) -> None:
    env = SlamEnv(str(folder), TARGET, frames="1:7", stride=2)
    env.reset(seed=0)
    env.step(0)
    assert [format_ns(ns) for ns in env.online_trajectory().timestamps_ns.tolist()] == stamps()[1:5:2]


@pytest.mark.parametrize("name", ["groundtruth.txt", "rgb.txt"])
def test_stamps_a_fifth_of_a_microsecond_apart_are_refused_before_tracking(
    store: RunStore, folder: Path, name: str, tmp_path: Path
) -> None:
    good = write_folder(tmp_path / "good", FRAMES)
    lines = (folder / name).read_text().splitlines()
    lines.insert(3, f"{format_ns(START + 2 * STEP + 200)} {lines[2].partition(' ')[2]}")
    (folder / name).write_text("\n".join(lines) + "\n")
    with pytest.raises(DynslamError, match=rf"{name} lines 3 and 4: .*200 ns apart") as caught:
        resolve(RunSpec(tracker=TARGET, sequence=str(folder)))
    assert "\n" not in str(caught.value)
    told: list[str] = []
    specs = [RunSpec(tracker=TARGET, sequence=str(place)) for place in (good, folder, good)]
    records = run_many(specs, results=store, on_fault=lambda spec, error: told.append(str(error)))
    assert [record.status for record in records] == ["ok", "ok"] and len(told) == 1
    assert store.ids() == [records[0].run_id]


def test_a_data_set_of_the_users_is_asked_for_the_same() -> None:
    sequence = ToySequence(6)
    sequence.timestamps = sequence.timestamps.copy()
    sequence.timestamps[3] = sequence.timestamps[2] + 2e-7
    with pytest.raises(SequenceError, match=r"frames of 'toy/walk': .*ns apart"):
        SlamEnv(sequence, TARGET)
    sequence = ToySequence(6)
    sequence.timestamps_ns = from_seconds(sequence.timestamps.tolist()) + 3
    env = SlamEnv(sequence, TARGET)
    env.reset(seed=0)
    assert env.online_trajectory().timestamps_ns.tolist() == sequence.timestamps_ns[:1].tolist()
