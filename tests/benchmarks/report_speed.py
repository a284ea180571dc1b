"""How long a report of thousands of runs takes to make and to open, and how much of it is loaded first.

    python tests/benchmarks/report_speed.py

Makes a results folder with files as large as those of real runs: trajectories, 39 columns of
``frames.csv``, snapshots of 1500 features and a mask on 30 frames, logs. Then seconds, processor
seconds and memory of `build_report`: without stored metrics, again with nothing changed, and anew
of scored runs (runs are scored as they end). In Chromium, the time from opening to the first
contentful paint and to the load event, with the bytes that were loaded until then.

Bars for 2000 runs on two idle cores: made in 30 s, first paint after 0.5 s, 1 MB loaded before the
script of plotly.
"""

import resource
import shutil
import sys
import tempfile
import time
from itertools import product
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))

from helpers.reports_browser import EXECUTABLE, Browser  # noqa: E402
from helpers.reports_fake_store import add_frames, add_run  # noqa: E402

from dynslam_bench.reports import build_report  # noqa: E402
from dynslam_bench.runs.record import IDENTITY_SCHEME  # noqa: E402
from dynslam_bench.runs.store import RunStore  # noqa: E402

STAGES = "segmentation features culling_box_depth culling_reseeding tracking mapping bundle_adjustment".split()
STATS = [
    *"keypoints culled matches inliers mask_fraction".split(),
    *(f"figure_{k}" for k in range(16)),
]
SETTINGS = {f"group_{k % 12}.setting_{k}": 0.5 * k for k in range(150)}
"""As many as trackers have; a run's record holds them twice."""
PAINT = "(performance.getEntriesByName('first-contentful-paint')[0] ?? {}).startTime"
LOAD = "performance.getEntriesByType('navigation')[0].loadEventEnd"


FRAMES = 200
TRACKERS = 20
SEQUENCES = 20
REPEATS = 5


def fill(root: Path) -> RunStore:
    """A results folder of 2,000 runs."""
    store = RunStore(root / "results")
    for number in range(SEQUENCES):
        pattern = root / "patterns" / str(number)
        pattern.mkdir(parents=True)
        add_frames(
            pattern, FRAMES, features=1500, size=(480, 640), stages=STAGES, stats=STATS, seed=number
        )
        for at, seed in product(range(TRACKERS), range(REPEATS)):
            quality = float(np.geomspace(0.005, 0.2, TRACKERS)[at])
            broken = (at + number + seed) % 37 == 0
            run_id = add_run(
                store, f"tracker-{at:02d}", f"synthetic/sequence_{number:02d}", seed,
                error=quality * (1 + 0.1 * seed), n=FRAMES, final_error=0.9 * quality,
                status="crashed" if broken else "ok", reason="RuntimeError: no map" if broken else "",
                lost=range(50, 60) if at % 4 == 0 else (), tags=("high-dynamic",) if number % 2 else ("static",),
                mask_iou=0.8, settings=SETTINGS, identity={"scheme": IDENTITY_SCHEME, "settings": SETTINGS},
            )  # fmt: skip
            for file in pattern.iterdir():
                shutil.copyfile(file, store.folder(run_id) / file.name)
    return store


def timed_report(store: RunStore, output: Path) -> str:
    """One report: the cells of a row."""

    def spent() -> float:
        return sum(
            sum(resource.getrusage(who)[:2])
            for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
        )

    began = time.perf_counter()
    before = spent()
    build_report(store, output)
    wall = time.perf_counter() - began
    processor = spent() - before
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    size = sum(path.stat().st_size for path in output.rglob("*") if path.is_file()) / 1e6
    return f"{wall:.0f} | {processor:.0f} | {peak:.0f} | {size:.0f}"


def opened(page: Path, folder: Path) -> str:
    """How fast the page opens, in words: the median of five times, a new address each, and what was loaded."""
    if EXECUTABLE is None:
        return "No browser is installed."
    browser = Browser(folder)
    times = []
    for _ in range(5):
        browser.open(page)
        browser.until(f"{PAINT} && {LOAD}")  # the first paint may be noted after the load event
        times.append(browser.run(f"[{PAINT}, {LOAD}]"))
    fetched = {url.removeprefix("file://") for url in browser.fetched if url.startswith("file://")}
    size = sum(Path(path).stat().st_size for path in fetched) / 1e6
    browser.close()
    paint, load = np.median(times, axis=0)
    assert not browser.faults, browser.faults
    return f"Its first page is shown after {paint / 1e3:.1f} s and loaded after {load / 1e3:.1f} s, with {size:.1f} MB."


def main() -> None:
    """Print seconds and megabytes."""
    with tempfile.TemporaryDirectory(prefix="report-speed-") as folder:
        store = fill(Path(folder))
        store.index.path.unlink(missing_ok=True)
        print(f"| {len(store.ids())} runs | s | processor s | at most MB of memory | MB written |")
        print("| --- | ---: | ---: | ---: | ---: |")
        output = Path(folder) / "report"
        for name in ("nothing scored", "nothing changed", "all scored, new report"):
            if name.startswith("all"):
                shutil.rmtree(output)
            print(f"| {name} | {timed_report(store, output)} |", flush=True)
        print("\n" + opened(output / "index.html", Path(folder) / "browser"), flush=True)


if __name__ == "__main__":
    main()
