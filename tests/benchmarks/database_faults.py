"""A study's database with workers that begin at the same time, and with a restart in mid-study.

    python tests/benchmarks/database_faults.py URL [--workers 4] [--restart COMMAND]

`URL` names an empty database, e.g. ``postgresql+psycopg://name@/empty?host=/run/postgresql``. With `--restart` the
command (one that stops the server and starts it again) is run while a worker makes trials.

Bars: every worker opens the study; the worker outlasts the restart with every trial it began finished.
"""

from __future__ import annotations

import argparse
import multiprocessing
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import optuna  # noqa: E402

from dynslam_bench.tuning.storage import open_database  # noqa: E402


def begin(url: str, barrier: Any, outcomes: Any) -> None:
    """Open the study at the same moment as all others."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    barrier.wait()
    try:
        optuna.create_study(storage=open_database(url), study_name="begin", load_if_exists=True)
        outcomes.put("opened")
    except Exception as error:
        outcomes.put(f"{type(error).__name__}: {str(error).splitlines()[0]}")


def restart(url: str, command: str, seconds: float = 12.0) -> Counter[str]:
    """Make trials while the server restarts; their states."""
    study = optuna.create_study(storage=open_database(url), study_name=f"restart-{time.time()}")
    thread = threading.Timer(3.0, lambda: subprocess.run(command, shell=True, check=True))
    thread.start()
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        trial = study.ask()
        study.tell(trial, trial.suggest_float("x", 0, 1))
    thread.join()
    return Counter(trial.state.name for trial in study.trials)


def main() -> int:
    """Print what became of the workers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("url")
    parser.add_argument("--workers", type=int, default=4)
    parser.add_argument("--restart")
    options = parser.parse_args()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    context = multiprocessing.get_context("spawn")
    barrier, outcomes = context.Barrier(options.workers), context.Queue()
    workers = [context.Process(target=begin, args=(options.url, barrier, outcomes)) for _ in range(options.workers)]
    for worker in workers:
        worker.start()
    found = Counter(outcomes.get() for _ in workers)
    sys.stdout.write(f"{options.workers} workers at the same time: {dict(found)}\n")
    fine = found["opened"] == options.workers
    if options.restart:
        states = restart(options.url, options.restart)
        sys.stdout.write(f"trials around a restart: {dict(states)}\n")
        fine = fine and set(states) == {"COMPLETE"}
    return 0 if fine else 1


if __name__ == "__main__":
    raise SystemExit(main())
