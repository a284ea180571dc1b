"""One run: what is stored of it, and that every way to fail becomes a status with a reason."""

import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from helpers.envs_play import play
from helpers.envs_toys import TARGET, ToySequence, write_folder

from dynslam_bench.contracts import KeyframeRecord, MapOutputs
from dynslam_bench.core import WEIGHTS_VARIABLE, DynslamError, RunError, SettingsError, TrackerError
from dynslam_bench.envs import SlamEnv
from dynslam_bench.evaluation import get_protocol
from dynslam_bench.geometry import format_ns, from_seconds, read_tum
from dynslam_bench.reports import make_board
from dynslam_bench.reports.model.names import make_labels
from dynslam_bench.reports.model.row import make_row, run_command
from dynslam_bench.runs import (
    RunRecord,
    RunSpec,
    RunStore,
    make_run_row,
    resolve,
    run_many,
    run_one,
    score,
)
from dynslam_bench.runs.artifacts import keep_map
from dynslam_bench.runs.frames import FrameLog, FrameRow, read_csv
from dynslam_bench.runs.identity import check_unchanged, start_map_of
from dynslam_bench.runs.rows import runs_frame
from dynslam_bench.slam.map_files import MAP_FILE, SavedMap, read_map, write_map
from dynslam_bench.slam.settings import BackendSettings, StartMapSettings

pytestmark = pytest.mark.slow


def leftovers(store: RunStore) -> list[str]:
    return [path.name for path in store.runs.iterdir() if path.name.startswith(".")]


def test_what_a_run_leaves(store: RunStore, toy_folder: str) -> None:
    record = run_one(
        RunSpec(
            tracker=TARGET,
            sequence=toy_folder,
            seed=3,
            settings={"noise.clip": 3.0, "mode": "ok"},
            snapshots=True,
        ),
        store,
    )
    assert (record.status, record.reason, record.n_frames, record.n_tracked, record.coverage) == (
        "ok",
        "",
        60,
        60,
        1.0,
    )
    folder = store.folder(record.run_id)
    assert len(list(folder.glob("frame_*.webp"))) >= 24
    assert sorted(path.name for path in folder.iterdir() if path.suffix != ".webp") == [
        "frames.csv",
        "log.txt",
        "run.json",
        "snapshots.npz",
        "trajectory_final.txt",
        "trajectory_online.txt",
    ]
    assert RunRecord.read(folder / "run.json") == record
    assert (store.root / "latest").resolve() == folder.resolve()
    assert leftovers(store) == []
    assert record.tracker.id == "toy"
    assert record.settings["noise.clip"] == 3.0
    assert record.overrides == {"noise.clip": 3}
    assert list(record.timings) == ["read", "total", "processor", "features", "tracking"]
    assert record.timings["tracking"].median_s == record.timings["tracking"].p95_s == 0.002
    assert record.peak_memory_mb
    assert 20 < record.peak_memory_mb < 4000
    assert record.machine
    assert record.machine.cores >= 1
    assert record.versions["numpy"] == np.__version__
    assert record.device == "cpu"
    assert record.sequence.ground_truth


def test_the_run_is_the_environment(store: RunStore, toy_folder: str) -> None:
    record = run_one(
        RunSpec(tracker=TARGET, sequence=toy_folder, seed=11, frames=(5, 45), stride=2), store
    )
    env = SlamEnv(toy_folder, TARGET, frames=(5, 45), stride=2)
    rewards, infos, ends = play(env, seed=11)
    assert len(rewards) == 19
    assert ends[-1] == (False, True)
    online = read_tum(store.folder(record.run_id) / "trajectory_online.txt")
    assert np.allclose(online.T_world_cam, env.online_trajectory().T_world_cam, atol=1e-8)
    rows = read_csv(store.folder(record.run_id) / "frames.csv")
    assert [row.reward_m for row in rows[1:]] == rewards
    assert rows[-1].pose_error_trans_m == infos[-1]["pose_error_trans_m"]
    assert rows[-1].stats["keypoints"] == 100
    assert rows[-1].timings["tracking"] == 0.002
    assert [row.state for row in rows] == ["ok"] * 20
    assert rows[0].frame_error_trans_m is None
    scored = score(store, record).metrics
    assert scored["ate_rmse_m"] == pytest.approx(
        infos[-1]["episode_metrics"]["ate_rmse_m"], rel=1e-5
    )


def test_a_start_offset_is_a_repeat_of_the_same_block(store: RunStore, toy_folder: str) -> None:
    spec = RunSpec(tracker=TARGET, sequence=toy_folder, frames=(10, 40))
    plain = run_one(spec, store)
    late = run_one(spec.model_copy(update={"offset": 2}), store)
    assert (plain.offset, plain.n_frames, plain.repeat) == (0, 30, "seed 0")
    assert (late.offset, late.n_frames, late.repeat) == (2, 28, "seed 0, offset 2")
    assert late.frames == (10, 40)
    assert late.sequence.block == plain.sequence.block
    assert late.sequence.part != plain.sequence.part
    cut = run_one(spec.model_copy(update={"frames": (12, 40)}), store)
    assert cut.run_id != late.run_id
    assert cut.sequence.block != late.sequence.block
    poses = [
        (store.folder(run.run_id) / "trajectory_online.txt").read_text().splitlines()[1:]
        for run in (late, cut)
    ]
    assert poses[0] == poses[1], "the tracker sees the same frames"
    assert len(store.timestamps(late.sequence.part)) == 28
    with pytest.raises(DynslamError, match="offset 30 leaves none of the 30 frames 10:40"):
        resolve(spec.model_copy(update={"offset": 30}))
    with pytest.raises(DynslamError, match=r"hold none of the 60 frames"):
        resolve(RunSpec(tracker=TARGET, sequence=toy_folder, offset=60))


@pytest.mark.parametrize(
    ("mode", "status", "reason"),
    [
        (
            "raise",
            "crashed",
            "frame 4 of 60: ValueError: the toy tracker raised on purpose (envs_toys.py:",
        ),
        ("segfault", "crashed", "SIGSEGV (segmentation fault), after frame 3 of 60"),
        (
            "nan",
            "invalid",
            "tracker 'toy' at frame 4 returned a pose with 16 values that are not finite",
        ),
        (
            "memoryerror",
            "out-of-memory",
            "frame 4 of 60: MemoryError: the toy tracker ran out of memory on purpose (envs",
        ),
        ("lost", "lost", "tracked on 4 of 60 frames"),
        ("initialising", "lost", "tracked on 4 of 60 frames"),
    ],
)
def test_every_failure_is_a_record_with_status_and_reason(
    store: RunStore, toy_folder: str, mode: str, status: str, reason: str
) -> None:
    record = run_one(RunSpec(tracker=TARGET, sequence=toy_folder, settings={"mode": mode}), store)
    assert record.status == status
    assert record.reason.startswith(reason)
    logged = {"raise": "Traceback", "segfault": "Segmentation fault"}.get(mode, "")
    assert logged in (store.folder(record.run_id) / "log.txt").read_text()
    assert store.read(record.run_id) == record
    assert record.n_tracked == 4
    assert record.coverage == pytest.approx(4 / 60)
    assert len(store.trajectory(record.run_id)) == 4  # what it had done is kept
    assert leftovers(store) == []


@pytest.mark.parametrize(
    ("at", "until", "status", "reason"),
    [
        (20, 40, "ok", ""),
        (50, 100, "lost", "lost from frame 50 to the end, tracked on 50 of 60 frames"),
        (55, 100, "ok", ""),
    ],
)
def test_lost_at_the_end_and_found_again(
    store: RunStore, toy_folder: str, at: int, until: int, status: str, reason: str
) -> None:
    settings = {"mode": "lost", "at": at, "until": until}
    record = run_one(RunSpec(tracker=TARGET, sequence=toy_folder, settings=settings), store)
    assert (record.status, record.reason) == (status, reason)


def test_partial_metrics_and_stopping(store: RunStore, toy_folder: str) -> None:
    seen = []

    def follow(run_id: str, partial: dict) -> bool:
        seen.append((run_id, partial))
        return len(seen) < 2

    record = run_one(
        RunSpec(tracker=TARGET, sequence=toy_folder), store, on_progress=follow, progress_every=10
    )
    assert record.status == "stopped"
    assert "stopped on request" in record.reason
    assert store.get(record.run_id) is None
    assert leftovers(store) == []
    assert [partial["frames_done"] for _, partial in seen][:2] == [10, 20]
    partial = seen[0][1]
    assert partial["frames"] == 60
    assert partial["metrics"]["coverage"] == 1
    assert partial["frame_time_s"] > 0
    assert 0 < partial["metrics"]["ate_rmse_m"] < 0.01
    seen.clear()
    whole = run_one(
        RunSpec(tracker=TARGET, sequence=toy_folder),
        store,
        on_progress=lambda *a: seen.append(a) or True,
    )
    assert [partial["frames_done"] for _, partial in seen] == [50, 60]
    assert seen[-1][1]["metrics"]["ate_rmse_m"] == pytest.approx(
        score(store, whole).metrics["ate_rmse_m"], rel=1e-5
    )


def test_degraded_and_dropped_frames(store: RunStore, toy_folder: str) -> None:
    record = run_one(
        RunSpec(tracker=TARGET, sequence=toy_folder, degrade={"noise": 0.5}, drop_share=0.4), store
    )
    assert record.status == "ok"
    assert record.n_dropped > 10
    assert record.coverage == pytest.approx(1 - record.n_dropped / 60)
    assert record.n_processed == 60 - record.n_dropped
    states = [row.state for row in read_csv(store.folder(record.run_id) / "frames.csv")]
    assert states.count("dropped") == record.n_dropped


def test_masks_are_compared_with_the_exact_ones(store: RunStore) -> None:
    spec = RunSpec(tracker="mask-rcnn", sequence="synthetic/walking_xyz", frames=(0, 4))
    record = run_one(spec.model_copy(update={"settings": {"segmentation.source": "oracle"}}), store)
    assert record.status == "ok"
    assert record.segmentation == "oracle"
    assert 0.3 < record.mask_iou <= 1
    assert record.epipolar_skipped is None, "it has no such test"
    assert {"keyframes.csv", "map.ply"} <= {
        path.name for path in store.folder(record.run_id).iterdir()
    }
    assert record.keyframes >= 1
    assert record.map_points > 10
    rows = read_csv(store.folder(record.run_id) / "frames.csv")
    assert np.mean([row.mask_iou for row in rows]) == pytest.approx(record.mask_iou)


def test_the_record_says_how_often_the_fundamental_matrix_was_not_used(store: RunStore) -> None:
    spec = RunSpec(tracker="emfoa-oft", sequence="synthetic/walking_xyz", frames=(0, 3))
    oracle = {"segmentation.source": "oracle"}
    never = run_one(
        spec.model_copy(update={"settings": {**oracle, "epipolar.min_parallax_px": 50.0}}), store
    )
    always = run_one(spec.model_copy(update={"tracker": "sof-slam", "settings": oracle}), store)
    assert (never.epipolar_skipped, always.epipolar_skipped) == (1.0, 0.0)
    assert [
        row.stats["epipolar_f_asked"] for row in read_csv(store.folder(never.run_id) / "frames.csv")
    ] == [0, 1, 1]


def test_frames_without_an_image_to_compare_with_do_not_count_as_skipped() -> None:
    def frame(state: str, asked: float, judged: float) -> FrameRow:
        return FrameRow(
            0,
            0.0,
            state,
            stats={"epipolar_f_asked": asked, "epipolar_f_judged": judged, "other": 1.0},
        )

    log = FrameLog(
        [
            frame("ok", 0, 0),
            frame("ok", 1, 1),
            frame("ok", 1, 0),
            frame("lost", 1, 0),
            frame("ok", 1, 0),
        ]
    )
    assert log.epipolar_skipped() == pytest.approx(2 / 3)
    assert FrameLog([FrameRow(0, 0.0, "ok", stats={"other": 1.0})]).epipolar_skipped() is None


def test_video(store: RunStore, toy_folder: str) -> None:
    record = run_one(RunSpec(tracker=TARGET, sequence=toy_folder, frames=(0, 5), video=True), store)
    data = (store.folder(record.run_id) / "video.webm").read_bytes()
    # Matroska's head, and a codec of browsers
    assert data.startswith(b"\x1aE\xdf\xa3")
    assert b"V_VP9" in data[:1000]


def test_sheet(store: RunStore) -> None:
    spec = RunSpec(tracker="orb-slam2", sequence="synthetic/sitting_xyz?frames=12", sheet=True)
    picture = cv2.imread(str(store.folder(run_one(spec, store).run_id) / "sheet.png"))
    assert picture.shape == (856, 1488, 3)
    panels = [picture[80:420, x : x + 460] for x in (20, 510, 1005)] + [
        picture[480:820, x : x + 460] for x in (270, 760)
    ]
    assert all(panel.std() > 4 for panel in panels), "each panel shows something"


def test_the_same_bits_on_one_thread_and_on_two(store: RunStore) -> None:
    """Features, flow, culling, tracking and mapping; the networks that make masks are not part of it."""
    folders = []
    for threads in (1, 2):
        spec = RunSpec(
            tracker="emfoa-oft",
            sequence="synthetic/walking_xyz?frames=6",
            seed=3,
            settings={"segmentation.source": "oracle"},
            threads=threads,
        )
        folders.append(store.folder(run_one(spec, store).run_id))
    assert folders[0] != folders[1]
    for name in ("trajectory_online.txt", "trajectory_final.txt", "keyframes.csv", "map.ply"):
        one, two = ((folder / name).read_bytes() for folder in folders)
        assert one == two, name
        assert len(one) > 100, name


ECHO = """#!{python}
import json, sys
sys.stderr.write("echo\\n")
for line in sys.stdin:
    request = json.loads(line)
    answer = dict(index=request.get("index"), state="ok", T_world_cam=[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1])
    print("on it", flush=True)
    print(json.dumps(answer), flush=True)
"""


def test_what_a_program_writes_is_in_the_log(
    store: RunStore, toy_folder: str, tmp_path: Path
) -> None:
    program = tmp_path / "slam"
    program.write_text(ECHO.format(python=sys.executable))
    program.chmod(0o755)
    spec = RunSpec(
        tracker=f"subprocess:{program}", sequence=toy_folder, frames=(0, 3), label="my SLAM"
    )
    record = run_one(spec, store)
    assert record.status == "ok"
    assert record.tracker.label == "my SLAM"
    log = (store.folder(record.run_id) / "log.txt").read_text()
    assert "[slam] echo" in log
    assert "[slam] on it" in log


START = 1403636579763555584
STEP = 33_333_337
FRAMES = 8


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A toy sequence with the stamps of a bag."""
    folder = write_folder(tmp_path / "toy", FRAMES)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        lines = [
            line.partition(" ")[2]
            for line in (folder / name).read_text().splitlines()
            if line[0] != "#"
        ]
        (folder / name).write_text(
            "".join(f"{text} {rest}\n" for text, rest in zip(stamps(), lines, strict=True))
        )
    return folder


def stamps() -> list[str]:
    return [format_ns(START + STEP * index) for index in range(FRAMES)]


def test_every_file_of_a_run_has_the_frames_own_stamps(store: RunStore, folder: Path) -> None:
    record = run_one(RunSpec(tracker=TARGET, sequence=str(folder)), store)
    made = store.folder(record.run_id)
    part = store.root / "sequences" / record.sequence.part
    for path in (
        made / "trajectory_online.txt",
        made / "trajectory_final.txt",
        part / "timestamps.txt",
        part / "groundtruth.txt",
    ):
        assert [
            line.split()[0] for line in path.read_text().splitlines() if line[0] != "#"
        ] == stamps(), path.name
    assert [
        line.split(",")[1] for line in (made / "frames.csv").read_text().splitlines()[1:]
    ] == stamps()
    assert record.status == "ok"
    assert score(store, record).metrics["ate_rmse_m"] > 0


def test_a_part_of_a_sequence_has_the_stamps_of_its_frames(folder: Path) -> None:
    env = SlamEnv(str(folder), TARGET, frames="1:7", stride=2)
    env.reset(seed=0)
    env.step(0)
    assert [format_ns(ns) for ns in env.online_trajectory().timestamps_ns.tolist()] == stamps()[
        1:5:2
    ]


def test_a_data_set_of_the_users_may_state_its_nanoseconds() -> None:
    sequence = ToySequence(6)
    sequence.timestamps_ns = from_seconds(sequence.timestamps.tolist()) + 3
    env = SlamEnv(sequence, TARGET)
    env.reset(seed=0)
    assert env.online_trajectory().timestamps_ns.tolist() == sequence.timestamps_ns[:1].tolist()


# What cannot run, and what raises outside the tracker's own code, is no outcome: one line, and
# nothing is stored.


@pytest.fixture
def odd_masks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with no network, no weights, and masks of a third of the frames; nothing can be fetched."""
    monkeypatch.setattr(
        "urllib.request.OpenerDirector.open", Mock(side_effect=OSError("network is unreachable"))
    )
    monkeypatch.setattr("dynslam_bench.core.download._LONGEST_PAUSE_S", 0.0)
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "weights"))
    (tmp_path / "garbage.onnx").write_bytes(b"no network at all" * 20)
    (tmp_path / "masks").mkdir()
    for index in range(20):
        cv2.imwrite(str(tmp_path / "masks" / f"{index:06d}.png"), np.zeros((120, 160), np.uint8))
    return tmp_path


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("onnx:{}/none.onnx", r"cannot read the network .*none\.onnx"),
        ("onnx:{}/garbage.onnx", r"garbage\.onnx is not an ONNX model \(340 bytes\)"),
        ("weights:{}/none.pt", r"cannot read the checkpoint .*none\.pt"),
        ("weights:{}/garbage.onnx", r"is no torch checkpoint of plain weights"),
        ("recorded:{}/none", r"recorded masks .*none does not exist"),
        ("recorded:{}/masks", r"has none for 40 of 60 frames of '.*', the first is frame 20"),
        ("oracle", r"has no exact masks"),
        (
            "auto",
            r"^(?!.*segmentation\.source=none)no masks for .*COCO checkpoint \(170 MB\).*0\.25 MB, Apache-2\.0"
            r".*onnx:PATH.*masks=none",
        ),
        ("plugin:mine", r"unknown segmenter 'mine'"),
    ],
)
def test_masks_that_cannot_be_had(
    store: RunStore, toy_folder: str, odd_masks: Path, source: str, words: str
) -> None:
    settings = {"segmentation.source": source.format(odd_masks)}
    spec = RunSpec(tracker="mask-rcnn", sequence=toy_folder, settings=settings)
    for attempt in (
        lambda: run_one(spec, store),
        lambda: run_many([RunSpec(tracker="never-move", sequence=toy_folder), spec], results=store),
        lambda: SlamEnv(toy_folder, "mask-rcnn", settings=settings),
    ):
        with pytest.raises(DynslamError, match=words):
            attempt()
    assert store.ids() == []


@pytest.mark.usefixtures("odd_masks")
def test_coco_without_a_network(store: RunStore, toy_folder: str) -> None:
    spec = RunSpec(
        tracker="mask-rcnn", sequence=toy_folder, settings={"segmentation.source": "coco"}
    )
    with pytest.raises(
        DynslamError, match=r"cannot fetch the checkpoint 'coco': .*network is unreachable \(put"
    ):
        run_one(spec, store)
    assert store.ids() == []


def test_what_only_the_run_can_find_out_is_refused_likewise(
    store: RunStore, toy_folder: str, tmp_path: Path
) -> None:
    """A plug-in that finds its own settings unfit when it is built, in the child."""
    (tmp_path / "picky.py").write_text(
        "from dynslam_bench.core.errors import SettingsError\n"
        "from dynslam_bench.trackers import TrackerSpec\n"
        "def build(settings):\n"
        "    raise SettingsError('the calibration file is missing', 'set calibration=FILE')\n"
        "SPEC = TrackerSpec('picky', f'{__file__}:build', 'Picky')\n"
    )
    with pytest.raises(
        DynslamError,
        match=r"picky cannot run on .*: frame 0 of 60: the calibration file is missing",
    ):
        run_one(RunSpec(tracker=f"{tmp_path}/picky.py:SPEC", sequence=toy_folder), store)
    assert store.ids() == []


AT = 5


@pytest.fixture
def damaged(tmp_path: Path) -> tuple[str, Path]:
    """A sequence, and its colour image of frame `AT`."""
    folder = write_folder(tmp_path / "toy", FRAMES)
    return str(folder), folder / (folder / "rgb.txt").read_text().split()[2 * AT + 1]


@pytest.mark.parametrize("spoilt", ["image", "mask"])
def test_what_cannot_be_read_is_the_datas_fault(
    store: RunStore, damaged, tmp_path: Path, spoilt: str
) -> None:
    folder, image = damaged
    masks = tmp_path / "masks"
    masks.mkdir()
    for index in range(FRAMES):
        cv2.imwrite(str(masks / f"{index:06d}.png"), np.zeros((120, 160), np.uint8))
    file = image if spoilt == "image" else masks / f"{AT:06d}.png"
    sound = file.read_bytes()
    # decoders go by the content, not by the name
    jpeg = cv2.imencode(".jpg", cv2.imread(str(file)))[1].tobytes()
    file.write_bytes(jpeg[: len(jpeg) // 2])
    spec = RunSpec(
        tracker="mask-rcnn", sequence=folder, settings={"segmentation.source": f"recorded:{masks}"}
    )
    with pytest.raises(RunError, match=rf"frame {AT} of .*{file.name} is truncated"):
        run_one(spec, store)
    assert store.ids() == []
    file.write_bytes(sound)
    assert run_one(spec, store).status in ("ok", "lost")


def test_one_bad_sequence_stops_no_other(store: RunStore, damaged, tmp_path: Path) -> None:
    folder, image = damaged
    good = [str(shutil.copytree(folder, tmp_path / name)) for name in ("first", "second")]
    image.write_text("no image")
    missing = str(tmp_path / "missing")
    specs = [
        RunSpec(tracker="never-move", sequence=name) for name in (good[0], folder, missing, good[1])
    ]
    told: list[tuple[str, str]] = []
    records = run_many(
        specs, results=store, on_fault=lambda spec, error: told.append((spec.sequence, str(error)))
    )
    assert [record.place for record in records] == good
    assert sorted(store.ids()) == sorted(r.run_id for r in records)
    assert [sequence for sequence, _ in told] == [missing, folder]
    with pytest.raises(DynslamError, match="missing"):  # nobody is told: raised at the end
        run_many(specs, results=store)


SEQUENCE = "synthetic/walking_xyz"
PLAIN = RunSpec(tracker="orb-slam2", sequence=SEQUENCE, frames=(0, 3), save_map=True)


def begun(file: Path, **changes: object) -> RunSpec:
    """A run on later frames of the scene that begins in a map and leaves it alone."""
    settings = {"backend.map.file": str(file), "backend.map.localisation_only": True}
    return PLAIN.model_copy(update={"frames": (3, 6), "settings": settings, **changes})


def test_a_run_begins_in_the_map_of_another_and_says_so(store: RunStore, tmp_path: Path) -> None:
    file = tmp_path / MAP_FILE
    first = SlamEnv(SEQUENCE, "orb-slam2", frames=(0, 3))
    with pytest.raises(TrackerError, match="has not begun"):
        first.save_map(file)
    first.reset(seed=0)
    first.step(0)
    first.save_map(str(file), "another run")
    (found,) = run_many([begun(file)], results=store)
    assert found.status == "ok"
    assert found.n_tracked == 3
    assert found.maps == 1
    own = read_map(store.folder(found.run_id) / MAP_FILE)
    assert "frames 3:6, seed 0" in own.header.made_by
    assert all(
        own.arrays[name].tobytes() == array.tobytes()
        for name, array in read_map(file).arrays.items()
    )
    begun_in = found.start_map
    assert begun_in is not None
    assert begun_in.localisation_only
    assert begun_in.made_by == "another run"
    assert (begun_in.keyframes, begun_in.points) == (found.keyframes, found.map_points)
    assert any("of another run, localisation only" in note for note in found.notes)
    keyframes = (store.folder(found.run_id) / "keyframes.csv").read_text().splitlines()
    assert len(keyframes) == 1 + found.keyframes
    assert all(line.split(",")[1:3] == ["", ""] for line in keyframes[1:])

    copy = tmp_path / "copy.npz"
    link = tmp_path / "latest"
    copy.write_bytes(file.read_bytes())
    link.symlink_to(file)
    assert resolve(begun(copy)).run_id == found.run_id, "what counts is the map, not where it lies"
    assert begun(link).absolute().settings["backend.map.file"] == str(file), (
        "another run moves the link"
    )
    assert (
        found.requested_settings
        == found.model_copy(
            update={"overrides": {"backend.map.localisation_only": "true"}}
        ).requested_settings
    )

    # another map at the same path is another run, and no repeat of the first
    other = tmp_path / "other.npz"
    write_map(
        other,
        SavedMap(
            read_map(file).header.model_copy(update={"made_by": "somebody"}), read_map(file).arrays
        ),
    )
    asked_before = resolve(begun(file))
    other.replace(file)
    again = resolve(begun(file))
    assert again.run_id != found.run_id
    assert again.start_map is not None
    with pytest.raises(RunError, match="changed since the run was asked for"):
        check_unchanged(asked_before)
    row = make_row(store, found, get_protocol("tum-rgbd/v1"))
    other_map = found.model_copy(update={"start_map": again.start_map})
    assert row.variant_key != make_row(store, other_map, get_protocol("tum-rgbd/v1")).variant_key
    assert not row.ranked, "it knows more than one that begins without"
    assert make_board([row]).reference is None
    name = f"map={begun_in.digest[:8]}"
    assert name in make_labels([row])[row.variant_key], (
        "named though no other variant stands beside it"
    )
    assert f"--map {file}" in run_command(row)
    assert "backend.map.localisation_only=true" in run_command(row)
    assert name in make_run_row(found, None)["settings"]
    assert name in runs_frame([(found, None)])["settings"][0]


def test_a_map_that_does_not_fit_is_refused_before_the_run(store: RunStore, tmp_path: Path) -> None:
    (tmp_path / "odd.npz").write_bytes(b"no archive")
    with pytest.raises(SettingsError, match="holds no arrays"):
        run_many([begun(tmp_path / "odd.npz")], results=store)
    assert not store.ids()


def test_maps_that_never_met_are_said(tmp_path: Path) -> None:
    keyframes = tuple(
        KeyframeRecord(i, i, i / 30, np.eye(4), 9, 9, number)
        for i, number in enumerate([0, 0, 1, 1, 1, 3])
    )
    none = np.zeros(0, np.int64)
    outputs = MapOutputs(keyframes, none, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), none)
    spec = RunSpec(tracker="a", sequence="b")
    _, counts, notes = keep_map(
        SimpleNamespace(map_outputs=lambda: outputs, exact_stamps={}), tmp_path, spec
    )
    assert counts["maps"] == 3
    assert notes[0].startswith(
        "3 maps that never met: 4 of 6 keyframes lie in others than the first"
    )
    one = MapOutputs(keyframes[:2], none, outputs.positions, outputs.colours, none)
    _, counts, notes = keep_map(
        SimpleNamespace(map_outputs=lambda: one, exact_stamps={}), tmp_path, spec
    )
    assert counts["maps"] == 1
    assert notes == []


def test_features_of_another_kind_begin_in_no_map() -> None:
    backend = BackendSettings(map=StartMapSettings(file="map.npz"))
    with pytest.raises(SettingsError, match="features are none that maps are made of"):
        start_map_of(SimpleNamespace(backend=backend, features=None), None, "rgbd", {})


@pytest.mark.parametrize("name", ["groundtruth.txt", "rgb.txt"])
def test_stamps_a_fifth_of_a_microsecond_apart_are_refused_before_tracking(
    folder: Path, name: str
) -> None:
    lines = (folder / name).read_text().splitlines()
    lines.insert(3, f"{format_ns(START + 2 * STEP + 200)} {lines[2].partition(' ')[2]}")
    (folder / name).write_text("\n".join(lines) + "\n")
    with pytest.raises(DynslamError, match=rf"{name}.*200 ns apart"):
        resolve(RunSpec(tracker=TARGET, sequence=str(folder)))
