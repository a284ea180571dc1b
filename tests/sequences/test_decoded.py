"""Frames that are decoded once: the same bits, found by content, one process decodes, faults are one line."""

import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from sequence_folders import make_folder

from dynslam_bench.core.errors import DynslamError, SequenceError
from dynslam_bench.core.folders import STAGES_VARIABLE
from dynslam_bench.core.stage_cache import StageCache
from dynslam_bench.envs import SlamEnv
from dynslam_bench.sequences import PreprocessingSettings, SequenceView, open_sequence
from dynslam_bench.sequences.decoded import Decoded
from dynslam_bench.sequences.readers import recorded
from dynslam_bench.testing import CornerSequence


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> StageCache:
    monkeypatch.setenv(STAGES_VARIABLE, str(tmp_path / "cache"))
    return StageCache()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return make_folder(tmp_path / "recording", frames=6)[0]


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The colour images that are decoded from now on."""
    names: list[str] = []
    read = recorded.read_colour

    def counted(path: Path, **how: object) -> np.ndarray:
        names.append(path.name)
        return read(path, **how)

    monkeypatch.setattr(recorded, "read_colour", counted)
    return names


def files(cache: StageCache) -> list[Path]:
    return sorted(cache.folder.rglob("*.*"))


def same(one: object, other: object) -> bool:
    pairs = list(zip(one, other, strict=True))
    return all(
        a.timestamp == b.timestamp and a.index == b.index and (a.rgb == b.rgb).all() and (a.depth == b.depth).all()
        for a, b in pairs
    )


def frames(sequence: object) -> Iterator[object]:
    return (sequence[index] for index in range(len(sequence)))


def test_frames_are_the_same_and_decoded_once(folder: Path, reads: list[str], cache: StageCache) -> None:
    plain = open_sequence(folder)
    mapped = Decoded(plain)
    reads.clear()
    again = Decoded(open_sequence(folder))
    assert len(reads) == 1, "opening decodes the first frame"
    assert same(frames(mapped), frames(again)) and len(reads) == 1
    assert same(frames(mapped), frames(plain)) and mapped[-1].index == 5
    assert (mapped.id, mapped.digest(), mapped.camera) == (plain.id, plain.digest(), plain.camera)
    assert mapped[0].rgb.dtype == np.uint8 and mapped[0].depth.dtype == np.float32
    assert len(files(cache)) == 1 and cache.info()["entries_by_stage"] == {"frames": 1}
    with pytest.raises(ValueError, match="read-only"):
        mapped[0].rgb[0] = 0


def test_other_frames_are_another_file(folder: Path, cache: StageCache) -> None:
    whole = open_sequence(folder)
    smaller = open_sequence(folder, preprocessing=PreprocessingSettings(width=16, height=16))
    variants = [whole, SequenceView(whole, 1), SequenceView(whole, 0, None, 2), smaller]
    for count, variant in enumerate(variants, 1):
        assert same(frames(Decoded(variant)), frames(variant)) and len(files(cache)) == count
    image = sorted((folder / "rgb").iterdir())[3]
    cv2.imwrite(str(image), 255 - cv2.imread(str(image)))
    changed = open_sequence(folder)
    assert same(frames(Decoded(changed)), frames(changed)) and len(files(cache)) == 5
    assert not same(frames(Decoded(changed)), frames(Decoded(whole)))


def test_of_several_processes_one_decodes(folder: Path, cache: StageCache) -> None:
    code = (
        "import sys\n"
        "from dynslam_bench.sequences import decoded, open_sequence\n"
        "write, count = decoded._write, []\n"
        "decoded._write = lambda *a: (count.append(1), write(*a))\n"
        "decoded.Decoded(open_sequence(sys.argv[1]))\n"
        "print(len(count))\n"
    )
    started = [
        subprocess.Popen([sys.executable, "-c", code, str(folder)], stdout=subprocess.PIPE, text=True) for _ in range(3)
    ]
    assert sorted(process.communicate()[0].strip() for process in started) == ["0", "0", "1"]
    assert len(files(cache)) == 1


def test_a_full_disk_is_one_line_and_leaves_nothing(folder: Path, cache: StageCache) -> None:
    sequence = open_sequence(folder)
    sequence.digest()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))  # as if the disk were full
    try:
        with pytest.raises(DynslamError, match=r"cannot write the 0 MB of decoded frames .*free some space") as caught:
            Decoded(sequence)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "\n" not in str(caught.value) and files(cache) == []
    assert len(Decoded(sequence)) == 6


def test_more_frames_than_the_cache_holds_are_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(StageCache.__init__, "__defaults__", (None, 20_000))
    with pytest.raises(SequenceError, match=r"6 decoded frames of .*choose part of the sequence by frames"):
        Decoded(open_sequence(folder))


def test_a_damaged_image_is_named(folder: Path, cache: StageCache) -> None:
    image = sorted((folder / "depth").iterdir())[3]
    sequence = open_sequence(folder)
    image.write_bytes(image.read_bytes()[:40])
    with pytest.raises(SequenceError, match=image.name):
        Decoded(sequence)
    assert files(cache) == []


@pytest.mark.parametrize("tracker", ["orb-slam2", "emfoa-oft?masks=none", "opencv-odometry", "mask-rcnn"])
def test_an_episode_is_the_same_to_the_bit(tracker: str) -> None:
    sequence = "synthetic/walking_xyz?scene=0&frames=6" if tracker == "mask-rcnn" else CornerSequence(6)
    episodes = []
    for memory_map in (False, True):
        env = SlamEnv(sequence, tracker, observation=["stats", "rgb", "depth", "gray"], memory_map=memory_map)
        steps = [env.reset(seed=0)[0]] + [env.step(0)[0] for _ in range(5)]
        episodes.append([value.tobytes() for step in steps for value in step.values()])
        episodes[-1].append(env.online_trajectory().T_world_cam.tobytes())
    assert episodes[0] == episodes[1]
