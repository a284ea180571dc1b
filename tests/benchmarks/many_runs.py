"""What many runs cost beside their frames: looking them up, resuming when all are stored, listing them.

    python tests/benchmarks/many_runs.py FOLDER [--runs 1000 10000 100000]

FOLDER is a recording in TUM layout. Each number of runs is shared by two trackers, ten start offsets and as many seeds
as are needed. No frame is tracked: the stored runs are copies of one. Times are of the processor, in seconds, but the
one to the first run, which is the clock's.
"""

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from pathlib import Path

from dynslam_bench.runs import RunSpec, RunStore, list_runs, run_many
from dynslam_bench.runs.identity import Resolver


class Nowhere(Executor):
    """Takes runs and makes none."""

    def submit(self, *_: object) -> Future:
        return Future()


class LookedUp(Exception):
    """All runs are looked up."""


def specs(folder: str, count: int) -> Iterator[RunSpec]:
    for number in range(count):
        tracker = ("orb-slam2", "never-move")[number % 2]
        yield RunSpec(tracker=tracker, sequence=folder, offset=number // 2 % 10, seed=number // 20, device="cpu")


def look_up(folder: str, count: int, results: str) -> dict[str, float]:
    """The head's work until all runs are known and the first is handed out."""
    times: list[float] = []

    def looked_up(_: object) -> None:
        raise LookedUp

    began = time.monotonic()
    try:
        events = {"on_event": lambda event: times.append(time.monotonic() - began), "on_plan": looked_up}
        run_many(specs(folder, count), results=results, executor=Nowhere(), **events)
    except LookedUp:
        return {"first run": times[0], "look-up": time.process_time()}
    raise AssertionError("unreachable")


def fill(folder: str, count: int, results: str) -> dict[str, float]:
    """Store copies of one run, with its metrics, under the ids of all."""
    store = RunStore(results)
    (record,) = run_many([RunSpec(tracker="orb-slam2", sequence=folder, frames=(0, 30), device="cpu")], results=store)
    model, text, look, entries = store.folder(record.run_id), record.to_json(), Resolver(), []
    metrics = store.score(record)
    for spec in specs(folder, count):
        run_id = look(spec).run_id
        (store.runs / run_id).mkdir()
        for name in ("trajectory_online.txt", "trajectory_final.txt"):
            if (model / name).is_file():
                shutil.copy(model / name, store.runs / run_id)
        (store.runs / run_id / "run.json").write_text(text.replace(record.run_id, run_id))
        state = store.index.state(run_id, record.sequence.part)
        entries.append((run_id, state, metrics.to_line().replace(record.run_id, run_id)))
    store.index.write(f"metrics {metrics.protocol_digest}", metrics.code, entries)
    return {}


def resume(folder: str, count: int, results: str) -> dict[str, float]:
    """Look all up and take them from the store."""
    assert len(run_many(specs(folder, count), results=results)) == count
    return {"resume": time.process_time()}


def listing(folder: str, count: int, results: str) -> dict[str, float]:
    """All rows of ``runs list``."""
    assert len(list_runs(RunStore(results))[0]) == count + 1
    return {"list": time.process_time()}


PARTS = {"look_up": look_up, "fill": fill, "resume": resume, "listed": listing, "list": listing}


def main() -> None:
    """Run each part in a process of its own, and print a row a number of runs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--runs", type=int, nargs="+", default=[1000, 10_000, 100_000])
    parser.add_argument("--part", nargs=2, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.part:
        name, results = chosen.part
        values = PARTS[name](str(chosen.folder), chosen.runs[0], results)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(json.dumps(values | {"MB": peak}))
        return
    print("| Runs | First run begins | Look-up | Resume | First list | Later lists | Most memory, MB |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for count in chosen.runs:
        with tempfile.TemporaryDirectory() as results:
            measured = {}
            for name in PARTS:
                command = [sys.executable, __file__, str(chosen.folder), "--runs", str(count), "--part", name, results]
                measured[name] = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
        cells = [measured["look_up"]["first run"], measured["look_up"]["look-up"], measured["resume"]["resume"]]
        cells += [measured["listed"]["list"], measured["list"]["list"]]
        most = max(measured[name]["MB"] for name in ("look_up", "resume", "list"))
        print(f"| {count} | " + " | ".join(f"{cell:.1f}" for cell in cells) + f" | {most:.0f} |", flush=True)


if __name__ == "__main__":
    main()
