"""A results folder as runs would leave it, made of computed trajectories, not of runs; rows and tables of reports."""

import csv
import hashlib
import json

import numpy as np

from dynslam_bench.contracts.tracker import TrackResult
from dynslam_bench.core.fingerprint import Machine
from dynslam_bench.core.records import digest
from dynslam_bench.envs.episode import FrameOutcome
from dynslam_bench.evaluation import OnlineSample, get_protocol
from dynslam_bench.geometry import Trajectory, format_tum, from_seconds, se3
from dynslam_bench.reports import RunRow
from dynslam_bench.runs.artifacts import SnapshotWriter
from dynslam_bench.runs.frames import FrameRow, write_csv
from dynslam_bench.runs.record import (
    IDENTITY_SCHEME,
    RunRecord,
    SequenceInfo,
    StageTime,
    TrackerInfo,
)
from dynslam_bench.runs.store import RunStore

LABELS = {
    "orb-slam2": "ORB-SLAM2 (our back end)",
    "mask-rcnn": "Mask R-CNN (our back end)",
    "dynaslam": "DynaSLAM N+G (our back end)",
    "ds-slam": "DS-SLAM (our back end)",
}
MACHINE = Machine(cpu="Test CPU", cores=2, memory_gb=8.0, system="Linux 6 x86_64")


def truth_of(sequence, n=120):
    """A smooth path at 100 Hz with a hole, different for every sequence."""
    rng = np.random.default_rng(int(hashlib.sha256(sequence.encode()).hexdigest()[:8], 16))
    t = np.arange(3 * n + 6) / 90
    phase = rng.uniform(0, 6, 6)
    speed = rng.uniform(0.6, 1.8, 6)
    twist = np.sin(t[:, None] * speed + phase) * [0.5, 0.4, 0.3, 0.15, 0.15, 0.2]
    stamps = np.round(1000.0 + t, 6)
    keep = (t < 2.0) | (t > 2.3)
    return Trajectory(stamps[keep], se3.exp(twist)[keep])


def stamps_of(n=120):
    return np.round(1000.01 + np.arange(n) / 30, 6)


def add_run(
    store,
    tracker,
    sequence,
    seed=0,
    error=0.01,
    status="ok",
    lost=(),
    n=120,
    ranked=True,
    label=None,
    provenance="faithful-paper",
    frame_s=0.02,
    overrides=None,
    tags=("high-dynamic",),
    mask_iou=None,
    ground_truth=True,
    started="2026-01-01T00:00:00+00:00",
    kind="run",
    reason="",
    command=("dynslam-bench", "bench", "dynamic"),
    final_error=None,
    online=True,
    copy_of=None,
    offset=0,
    noise=None,
    block=None,
    content=None,
    camera=None,
    place="",
    frames=None,
    cached=False,
    skipped=None,
    duration_s=None,
    masks="",
    settings=None,
    final_frames=None,
    final_whole=False,
    study="",
    given="",
    identity=None,
    run_id=None,
    deterministic=True,
    machine=MACHINE,
    sensors="rgbd",
):
    """Store one run whose trajectory is the truth with noise of the given size.

    Runs with the same `copy_of` have the same noise: what a deterministic tracker leaves.
    """
    stamps = stamps_of(n)[offset:]
    truth = truth_of(sequence, n)
    n = len(stamps)
    part = hashlib.sha256(
        f"{sequence} {content or ''} {frames} {offset or ''}".encode()
    ).hexdigest()[:16]
    store.prepare()
    store.add_sequence(part, from_seconds(stamps.tolist()), truth if ground_truth else None)
    made_of = {"t": tracker, "s": sequence, "seed": seed, "o": overrides or {}, "started": started, "kind": kind,
                "extra": (offset, noise, content, camera, frames, online, masks)}  # fmt: skip
    if identity is not None:
        made_of["identity"] = repr(identity)
    run_id = run_id or hashlib.sha256(repr(made_of).encode()).hexdigest()[:20]
    rng = np.random.default_rng(int(run_id[:8], 16) if copy_of is None else copy_of)
    nearest = np.abs(truth.timestamps[:, None] - stamps).argmin(0)
    drift = np.cumsum(rng.normal(0, 1, (n, 6)), axis=0)
    drift = (drift - drift.mean(0)) / drift.std() * error
    poses = (
        se3.exp(rng.normal(size=6))
        @ truth.T_world_cam[nearest]
        @ se3.exp(drift * [1, 1, 1, 0.3, 0.3, 0.3])
    )
    ended = status in ("ok", "stopped")
    ok = ~np.isin(np.arange(n), lost) & (ended | (np.arange(n) < n // 4))
    record = RunRecord(
        kind=kind, run_id=run_id, status=status, reason=reason,
        tracker=TrackerInfo(id=tracker, label=label or tracker, provenance=provenance, ranked=ranked, given=given,
                            deterministic=deterministic, sensors=sensors),
        overrides=overrides or {}, seed=seed, device="cpu",
        sequence=SequenceInfo(id=sequence, part=part, frames=n, duration_s=duration_s or n / 30, fps=30.0,
                              content=content or "", block=digest(block, 16) if block else "", noise=noise,
                              ground_truth=ground_truth,
                              tags=list(tags)),
        frames=frames, offset=offset, place=place, epipolar_skipped=skipped,
        identity=({"scheme": IDENTITY_SCHEME} if identity is None else identity)
        | ({"cache": True} if cached else {}) | ({"camera": camera} if camera else {}),
        n_frames=n, n_processed=n if ended or status == "lost" else n // 4,
        n_tracked=int(ok.sum()), n_lost=int((~ok).sum()), coverage=float(ok.mean()),
        timings={"total": StageTime(median_s=frame_s, p95_s=2 * frame_s, mean_s=frame_s)} if frame_s else {},
        started=started, wall_s=3.0, peak_memory_mb=300.0, machine=machine, versions={"python": "3.11", "numpy": "2.0"},
        mask_iou=mask_iou, segmentation=masks, command=list(command), settings=settings or {}, study=study,
    )  # fmt: skip
    with store.work_folder(run_id) as work:
        if ok.any() and online:
            (work / "trajectory_online.txt").write_text(
                format_tum(Trajectory(stamps[ok], poses[ok]))
            )
        if final_error is not None:
            kept = ok | final_whole
            better = truth.T_world_cam[nearest] @ se3.exp(drift * final_error / error)
            (work / "trajectory_final.txt").write_text(
                format_tum(
                    Trajectory(stamps[kept], better[kept]).select(final_frames or slice(None))
                )
            )
        (work / "log.txt").write_text("a log\n")
        store.publish(work, record)
    return run_id


def add_frames(
    folder,
    count,
    *,
    exact=True,
    masks=True,
    features=50,
    size=(48, 64),
    stages=("features",),
    stats=("keypoints",),
    seed=0,
):
    """Frames and snapshots as a run would leave them: the error grows with the share of dynamic pixels."""
    rows = []
    writer = SnapshotWriter(folder, count)
    rng = np.random.default_rng(seed)
    for at in range(count):
        share = at / count
        error = OnlineSample(
            trans_m=0.01, rot_deg=0.1, frame_trans_m=0.001 * (1 + 9 * share), frame_rot_deg=0.1
        )
        numbers = dict(zip(stats, rng.uniform(0, 1500, len(stats)).tolist(), strict=True))
        numbers |= {
            "keypoints": float(features),
            "culled": 0.4 * features,
            "mask_fraction": masks * share,
        }
        times = {"read": 0.001, "total": 0.02, "processor": 0.03} | dict.fromkeys(stages, 0.01)
        outcome = FrameOutcome(
            at, 1000.01 + at / 30, "ok", np.eye(4), numbers, times, error, -0.001
        )
        rows.append(FrameRow.of(outcome, 0.5, share if exact else None))
        points = rng.uniform(0, size, (features, 2)).astype(np.float32)[:, ::-1]
        mask = np.broadcast_to(np.arange(size[1]) < int(size[1] * share), size)
        kept = np.arange(features) >= 0.4 * features
        writer.add(
            outcome,
            np.full((*size, 3), 90, np.uint8),
            TrackResult(np.eye(4), "ok", numbers, times, mask, points, kept),
        )
    writer.write()
    write_csv(folder / "frames.csv", rows)


def fill(root, trackers=None, sequences=None, seeds=(0, 1, 2)):
    """A small benchmark: four trackers, one that fails now and then, one control, on four sequences."""
    store = RunStore(root)
    names = ("walking_xyz", "walking_rpy", "sitting_xyz", "sitting_static")
    sequences = sequences or [f"synthetic/{name}" for name in names]
    quality = trackers or {"orb-slam2": 0.10, "mask-rcnn": 0.02, "dynaslam": 0.015, "ds-slam": 0.05}
    for sequence in sequences:
        dynamic = "walking" in sequence
        tags = ("high-dynamic",) if dynamic else ("low-dynamic",)
        for seed in seeds:
            for speed, (name, error) in enumerate(quality.items(), start=1):
                broken = name == "ds-slam" and sequence.endswith("walking_rpy") and seed == 1
                add_run(
                    store, name, sequence, seed,
                    error=error * (1 + 0.2 * seed) if dynamic else 0.012 + 0.1 * error,
                    status="crashed" if broken else "ok",
                    reason="RuntimeError: the map is empty" if broken else "",
                    lost=range(50, 70) if name == "orb-slam2" and dynamic else (),
                    label=LABELS.get(name, name),
frame_s=0.012 * speed, tags=tags, mask_iou=None if name == "orb-slam2" else 0.9 - 3 * error,
                )  # fmt: skip
            add_run(
                store, "constant-velocity", sequence, seed, error=0.3, ranked=False, label="constant velocity",
                provenance="control", frame_s=0.0001, tags=tags,
            )  # fmt: skip
    return store


# Rows and tables of reports as the tests make and read them.


PROTOCOL = get_protocol("tum-rgbd/v1")


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def page_data(folder, name):
    """What a side file of a report hands to its page."""
    text = (folder / "data" / f"{name}.js").read_text()
    return json.loads(text[text.index(",", text.index("keep(")) + 1 : text.rindex(")")])


SEQUENCE = {"block", "tags", "content", "noise", "duration_s"}
TRACKER = {"label", "provenance", "ranked", "deterministic"}


def row(tracker="a", sequence="s", error=0.1, variant=None, **changes):
    """A row of one run that ended; `variant` holds settings, device and threads."""
    info, spec = (
        {name: changes.pop(name) for name in names & set(changes)} for names in (SEQUENCE, TRACKER)
    )
    info["block"] = digest([info.get("block") or sequence, changes.get("frames")], 16)
    # every sequence is a recording of its own: no other has its duration
    own_s = int(info["block"][:4], 16) * 1e-5
    settings = dict(variant or {})
    changes |= {name: settings.pop(name) for name in ("device", "threads") if name in settings}
    base = dict(
        run_id=digest([tracker, sequence, error, str(changes), str(info), settings], 16), status="ok",
        sequence=dict(id=sequence, part="0" * 16, frames=60, duration_s=2 + own_s, fps=30, ground_truth=True) | info,
        tracker=dict(id=tracker, label=tracker.upper()) | spec, overrides=settings, settings=settings,
        protocol_id="p", protocol_digest="d", metrics={"ate_rmse_m": error, "rpe_1s_trans_rmse_m": error / 2},
        hold_last_pose_ate_m=error, static_camera_ate_rmse_m=0.3, coverage=1.0, n_frames=60, n_processed=60,
        n_tracked=60,
    )  # fmt: skip
    return RunRow(**(base | changes))


def crashed(tracker="c", sequence="s", error=0.001, **changes):
    """A run that died at frame 20 of 60, with a tiny error until then."""
    done = dict(status="crashed", n_processed=20, n_tracked=20, coverage=1 / 3, reason="boom")
    return row(tracker, sequence, error, **(done | changes))


def cell_of(table, name, column=1):
    return next(cells for cells in table.rows if cells[0].text == name)[column]


def cell_named(table, tracker, column):
    """The cell of a leaderboard in the row of a tracker and the column of a name."""
    headings = [heading.name for heading in table.columns]
    rows = {cells[headings.index("tracker")].text: cells for cells in table.rows}
    return rows[tracker][headings.index(column)]


def columns_of(table, *names):
    """The cells of some columns of a table."""
    headings = [column.name for column in table.columns]
    return [[cells[headings.index(name)] for cells in table.rows] for name in names]
