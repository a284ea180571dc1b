"""Many run records listed and reported: how long the first and every later list take, and the report.

    python tests/benchmarks/many_records.py [--records 100000] [--report]

Makes a results folder of so many runs, each stored as runs are (record, trajectory, errors), by giving the two runs of
`tests/fixtures` other ids, trackers, sequences and seeds. A list is `dynslam-bench runs list`, the report
`dynslam-bench report`; each runs in a process of its own, whose processor time is printed beside the wall time.

Bars: 100,000 records are listed within 3 s once they are known, and reported within 60 s.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FIXTURE = ROOT / "tests" / "fixtures" / "before_rebuild" / "results"
TRACKERS, SEQUENCES = 20, 50


def fill(results: Path, records: int) -> None:
    """Store so many runs; every file is written, none is a link."""
    shutil.copytree(FIXTURE / "sequences", results / "sequences")
    (metrics,) = (FIXTURE / "metrics").iterdir()
    old = min((FIXTURE / "runs").iterdir())
    record = (old / "run.json").read_text()
    scored = (metrics / f"{old.name}.json").read_text()
    track = (old / "trajectory_online.txt").read_text()
    tracker, sequence = ('"id": "never-move"', '"id": "synthetic/walking_xyz"')
    (results / "metrics" / metrics.name).mkdir(parents=True)
    for number in range(records):
        run = f"{number:016x}"
        folder = results / "runs" / run
        folder.mkdir(parents=True)
        seed = number // (TRACKERS * SEQUENCES)
        text = record.replace(old.name, run).replace('"seed": 0', f'"seed": {seed}')
        text = text.replace(tracker, f'"id": "tracker-{number % TRACKERS}"')
        text = text.replace(sequence, f'"id": "sequence/{number // TRACKERS % SEQUENCES}"')
        (folder / "run.json").write_text(text)
        (folder / "trajectory_online.txt").write_text(track)
        (results / "metrics" / metrics.name / f"{run}.json").write_text(scored.replace(old.name, run))


def timed(*arguments: str) -> tuple[float, float, float]:
    """Wall and processor seconds of a command of the command line, and the megabytes that the largest yet took."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    command = [sys.executable, "-m", "dynslam_bench.cli", *arguments]
    subprocess.run(command, env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=subprocess.DEVNULL, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return time.monotonic() - began, used, after.ru_maxrss / 1024


def main() -> int:
    """Print the times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=100_000)
    parser.add_argument("--report", action="store_true", help="time the report, too")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="many-records-") as folder:
        results = Path(folder) / "results"
        fill(results, options.records)
        found = {}
        steps = ["first list", "second list", *(["report"] if options.report else [])]
        for what in steps:
            report = ["report", str(results), "-o", f"{folder}/report"]
            found[what] = timed(*(report if what == "report" else ["runs", "list", "--results", str(results)]))
            wall, used, memory = found[what]
            sys.stdout.write(
                f"{what} of {options.records} records: {wall:.1f} s, {used:.1f} s of processor, {memory:.0f} MB\n"
            )
            sys.stdout.flush()
    return 0 if found["second list"][1] <= 3 and found.get("report", (0, 0, 0))[1] <= 60 else 1


if __name__ == "__main__":
    raise SystemExit(main())
