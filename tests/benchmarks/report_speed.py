"""How long a report of thousands of runs takes to make and to open, and how much of it is loaded first.

    python tests/benchmarks/report_speed.py [--trackers 20] [--sequences 20] [--repeats 5] [--keep FOLDER]

Makes a results folder with files as large as those of real runs: trajectories, 39 columns of ``frames.csv``, snapshots
of 1500 features and a mask on 30 frames, logs. Then, without any stored metrics: seconds, processor seconds and memory
of `build_report`, once and once more (as after the next run), and in headless Chromium the time from opening to the
first contentful paint and to the load event, with the bytes that were loaded until then.

Bars for 2000 runs on two cores: made in 30 s, opened in 1 s, 3 MB loaded first.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "reports")]

from reports_browser import EXECUTABLE, Browser  # noqa: E402
from reports_fake_store import add_run  # noqa: E402

from dynslam_bench.contracts.tracker import TrackResult  # noqa: E402
from dynslam_bench.envs.episode import FrameOutcome  # noqa: E402
from dynslam_bench.evaluation.online import OnlineSample  # noqa: E402
from dynslam_bench.reports import build_report  # noqa: E402
from dynslam_bench.runs.artifacts import SnapshotWriter  # noqa: E402
from dynslam_bench.runs.frames import FrameRow, write_csv  # noqa: E402
from dynslam_bench.runs.store import RUN_FILE, RunStore  # noqa: E402

STAGES = "segmentation features culling_box_depth culling_reseeding tracking mapping bundle_adjustment".split()
STATS = [*"keypoints culled matches inliers mask_fraction".split(), *(f"figure_{k}" for k in range(16))]
SETTINGS = {f"group_{k % 12}.setting_{k}": 0.5 * k for k in range(150)}
"""As many as trackers have; a run's record holds them twice."""
PAINT = "(performance.getEntriesByName('first-contentful-paint')[0] ?? {}).startTime"
LOAD = "performance.getEntriesByType('navigation')[0].loadEventEnd"


def write_pattern(folder: Path, frames: int, seed: int) -> None:
    """``frames.csv`` and ``snapshots.npz`` as a run leaves them."""
    folder.mkdir(parents=True)
    rng, rows, writer = np.random.default_rng(seed), [], SnapshotWriter(folder, frames)
    for at in range(frames):
        stats = dict(zip(STATS, rng.uniform(0, 1500, len(STATS)).tolist(), strict=True))
        stats["mask_fraction"] = 0.5 * at / frames
        times = dict.fromkeys(("read", "total", *STAGES), 0.0)
        times = {name: value for name, value in zip(times, rng.gamma(2, 0.02, len(times)).tolist(), strict=True)}
        error = OnlineSample(
            trans_m=0.01 + at * 1e-4, rot_deg=0.1, frame_trans_m=float(rng.gamma(2, 1e-3)), frame_rot_deg=0.05
        )
        outcome = FrameOutcome(at, 1000.01 + at / 30, "ok", np.eye(4), stats, times, error, -0.001)
        rows.append(FrameRow.of(outcome, 0.8, 0.5 * at / frames))
        mask = np.zeros((480, 640), bool)
        mask[:, 200 + at % 200 : 400 + at % 200] = True
        points = rng.uniform((0, 0), (640, 480), (1500, 2)).astype(np.float32)
        writer.add(outcome, (480, 640, 3), TrackResult(np.eye(4), "ok", stats, times, mask, points, points[:, 0] > 200))
    writer.write()
    write_csv(folder / "frames.csv", rows)


def fill(root: Path, trackers: int, sequences: int, repeats: int, frames: int) -> RunStore:
    """A results folder of so many runs."""
    store, patterns = RunStore(root / "results"), root / "patterns"
    for number in range(sequences):
        write_pattern(patterns / str(number), frames, number)
    qualities = np.geomspace(0.005, 0.2, trackers)
    for number in range(sequences):
        for at, quality in enumerate(qualities):
            for seed in range(repeats):
                broken = (at + number + seed) % 37 == 0
                run_id = add_run(
                    store, f"tracker-{at:02d}", f"synthetic/sequence_{number:02d}", seed,
                    error=float(quality * (1 + 0.1 * seed)), n=frames, final_error=float(0.9 * quality),
                    status="crashed" if broken else "ok", reason="RuntimeError: no map" if broken else "",
                    lost=range(50, 60) if at % 4 == 0 else (), tags=("high-dynamic",) if number % 2 else ("static",),
                    mask_iou=0.8,
                )  # fmt: skip
                for name in ("frames.csv", "snapshots.npz"):
                    shutil.copyfile(patterns / str(number) / name, store.folder(run_id) / name)
                record = store.read_whole(run_id)
                asked = record.identity | {"settings": SETTINGS}
                record = record.model_copy(update={"settings": SETTINGS, "identity": asked})
                (store.folder(run_id) / RUN_FILE).write_text(record.to_json())
    return store


def timed_report(store: RunStore, output: Path) -> str:
    """One report, in words."""

    def spent() -> float:
        return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))

    began, before = time.perf_counter(), spent()
    build_report(store, output)
    wall, processor = time.perf_counter() - began, spent() - before
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    size = sum(path.stat().st_size for path in output.rglob("*") if path.is_file()) / 1e6
    return f"{wall:.1f} s ({processor:.1f} s of processors), at most {peak:.0f} MB of memory, {size:.0f} MB written"


def opened(page: Path, folder: Path) -> str:
    """How fast the page opens, in words: the median of five times, a new address each, and what was loaded."""
    if EXECUTABLE is None:
        return "no browser is installed"
    browser = Browser(folder)
    paints, loads = [], []
    for _ in range(5):
        browser.open(page)
        browser.until(f"{PAINT} && {LOAD}")  # the first paint may be noted after the load event
        paints.append(browser.run(PAINT))
        loads.append(browser.run(LOAD))
    fetched = {url.removeprefix("file://") for url in browser.fetched if url.startswith("file://")}
    size = sum(Path(path).stat().st_size for path in fetched) / 1e6
    faults = browser.faults
    browser.close()
    paint, load = np.median(paints), np.median(loads)
    return f"first paint after {paint:.0f} ms, loaded after {load:.0f} ms, {size:.2f} MB loaded first, faults {faults}"


def main() -> None:
    """Print seconds and megabytes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in {"trackers": 20, "sequences": 20, "repeats": 5, "frames": 200}.items():
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--keep", type=Path, help="folder for the results, used again if it is there")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="report-speed-") as folder:
        root = options.keep or Path(folder)
        store = RunStore(root / "results")
        if not store.runs.is_dir():
            fill(root, options.trackers, options.sequences, options.repeats, options.frames)
        for known in ("metrics", "index"):
            shutil.rmtree(store.root / known, ignore_errors=True)
        print(f"{len(store.ids())} runs", flush=True)
        output = Path(folder) / "report"
        for name in ("first", "again"):
            print(f"{name}: {timed_report(store, output)}", flush=True)
        print(opened(output / "index.html", Path(folder) / "browser"), flush=True)


if __name__ == "__main__":
    main()
