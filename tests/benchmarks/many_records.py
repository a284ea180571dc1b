"""Many run records listed and reported: how long the first and every later list take, and the report.

    python tests/benchmarks/many_records.py [--records 100000] [--report] [--keep FOLDER]

Makes a results folder of so many runs, each stored as runs are (record, trajectory, errors), by giving a run of
`tests/fixtures` other ids, trackers, sequences, seeds, errors and settings. A list is `dynslam-bench runs list`, the
report `dynslam-bench report`; each runs in a process of its own, whose processor time (with that of its helpers) is
printed beside the wall time, and the memory of the largest process.

Bars: 100,000 records are listed within 3 s once they are known, and reported within 60 s on two cores.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from datetime import datetime, timedelta, timezone
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from dynslam_bench.runs import RunStore  # noqa: E402

FIXTURE = ROOT / "tests" / "fixtures" / "results"
TRACKERS, SEQUENCES = 20, 50
SETTINGS = 120
"""As many as trackers have: a record of 12 KB."""


def fill(results: Path, records: int) -> None:
    """Store so many runs with their errors; every file is written, none is a link."""
    shutil.copytree(FIXTURE, results)
    store = RunStore(results)
    old = store.all()[0][0]
    scored = store.score(old)
    track = (store.folder(old.run_id) / "trajectory_online.txt").read_text()
    shutil.rmtree(store.runs)
    part, entries = old.sequence.part, []
    for number in range(records):
        tracker, sequence, repeat = number % TRACKERS, number // TRACKERS % SEQUENCES, number // (TRACKERS * SEQUENCES)
        run = hashlib.sha256(str(number).encode()).hexdigest()[:16]
        content = f"{sequence:016x}"
        record = old.model_copy(
            update={
                "run_id": run,
                "seed": repeat,
                "coverage": 1 - repeat / 1000,
                "started": (datetime(2026, 1, 1, tzinfo=timezone.utc) + timedelta(seconds=number)).isoformat(),
                "settings": {f"group_{at % 12}.setting_{at}": 0.5 * at for at in range(SETTINGS)},
                "tracker": old.tracker.model_copy(update={"id": f"tracker-{tracker}", "label": f"Tracker {tracker}"}),
                "sequence": old.sequence.model_copy(
                    update={"id": f"sequence/{sequence}", "content": content, "block": content}
                ),
            }
        )
        store.folder(run).mkdir(parents=True)
        (store.folder(run) / "run.json").write_text(record.to_json())
        (store.folder(run) / "trajectory_online.txt").write_text(track)
        error = {"ate_rmse_m": 0.01 * (1 + tracker) + 1e-3 * sequence + 1e-5 * repeat}
        online = scored.online.model_copy(update={"metrics": scored.online.metrics | error})
        metrics = scored.model_copy(update={"run_id": run, "online": online})
        entries.append((run, store.index.state(run, part), metrics.to_line()))
    store.index.write(f"metrics {scored.protocol_digest}", scored.code, entries)


def timed(*arguments: str) -> tuple[float, float, float]:
    """Wall and processor seconds of a command of the command line, and the megabytes of the largest process yet."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    command = [sys.executable, "-c", "from dynslam_bench.cli import main; main()", *arguments]
    subprocess.run(command, env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=subprocess.DEVNULL, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return time.monotonic() - began, used, after.ru_maxrss / 1024


def main() -> int:
    """Print the times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=100_000)
    parser.add_argument("--report", action="store_true", help="time reports, too")
    parser.add_argument("--keep", type=Path, help="folder for the results, used again if it is there")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="many-records-") as folder:
        results = (options.keep or Path(folder)).absolute() / "results"
        if not results.is_dir():
            fill(results, options.records)
        listed, reported = (
            ["runs", "list", "--results", str(results)],
            ["report", str(results), "-o", f"{folder}/report"],
        )
        steps = [("first list", listed), ("second list", listed)]
        steps += [("first report", reported), ("second report", reported)] if options.report else []
        walls = {}
        for what, command in steps:
            walls[what], used, memory = timed(*command)
            sys.stdout.write(f"{what}: {walls[what]:.1f} s, {used:.1f} s of processor, {memory:.0f} MB\n")
            sys.stdout.flush()
    return 0 if walls["second list"] <= 3 and walls.get("second report", 0) <= 60 else 1


if __name__ == "__main__":
    raise SystemExit(main())
