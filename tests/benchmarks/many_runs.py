"""What many runs cost beside their tracking, by their number, by Dask's workers and by their frames.

    python tests/benchmarks/many_runs.py FOLDER [--runs 1000 10000 100000]

FOLDER is a recording in TUM layout. First table: looking runs up while none is stored, resuming
when all are, finding the stored ones of runs that are looked up (a part of resuming), listing them,
and all runs as one frame. Each number of runs is shared by two trackers, ten start offsets and as
many seeds as are needed. No frame is tracked: the stored runs are copies of one, each with the
identity of its request. Times are of the processor, in seconds, each in a process of its own,
without the imports. The other tables: runs of `never-move`, which tracks nothing. Times are of the
processor, in milliseconds a run: of the process that asks for the runs, and of those that make
them.
"""

import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from itertools import chain
from multiprocessing import get_context

import psutil
from command_line import parser_of

from dynslam_bench.runs import PlannedRuns, RunSpec, RunStore, list_runs, run_many
from dynslam_bench.runs.cluster import DaskWorkers
from dynslam_bench.runs.identity import Resolver
from dynslam_bench.runs.layout import FINAL, ONLINE, RUN_FILE
from dynslam_bench.runs.lookup import LookUp


class LookedUp(Exception):
    """All runs are looked up."""


def specs(folder: str, count: int) -> Iterator[RunSpec]:
    for number in range(count):
        yield RunSpec(
            tracker=("orb-slam2", "never-move")[number % 2],
            sequence=folder,
            offset=number // 2 % 10,
            seed=number // 20,
            device="cpu",
        )


def look_up(folder: str, count: int, results: str) -> list[float]:
    """The head's work until all runs are known and the first could be handed out; none is stored."""

    def looked_up(_: object) -> None:
        raise LookedUp

    began = time.process_time()
    with suppress(LookedUp):
        run_many(specs(folder, count), results=results, on_plan=looked_up)
    return [time.process_time() - began]


def fill(folder: str, count: int, results: str) -> list[float]:
    """Store copies of one run, with its metrics, under the identities of all."""
    store = RunStore(results)
    (model,) = run_many(
        [RunSpec(tracker="orb-slam2", sequence=folder, frames=(0, 30), device="cpu")], results=store
    )
    resolver = Resolver()
    metrics = store.score(model)
    entries = []
    for spec in specs(folder, count):
        run = resolver(spec)
        record = model.model_copy(update={"run_id": run.run_id, "identity": run.identity})
        copy = store.folder(run.run_id)
        copy.mkdir()
        for name in (ONLINE, FINAL):
            if (store.folder(model.run_id) / name).is_file():
                shutil.copy(store.folder(model.run_id) / name, copy)
        (copy / RUN_FILE).write_text(record.to_json())
        line = metrics.model_copy(update={"run_id": run.run_id}).to_line()
        entries.append((run.run_id, store.index.state(run.run_id, model.sequence.part), line))
    store.index.write(f"metrics {metrics.protocol_digest}", metrics.code, entries)
    return []


def resume(folder: str, count: int, results: str) -> list[float]:
    """Look all up and take them from the store."""

    def not_stored(plan: PlannedRuns) -> None:
        raise AssertionError(f"{plan.runs} of {count} runs were not found")

    began = time.process_time()
    assert len(run_many(specs(folder, count), results=results, on_plan=not_stored)) == count
    return [time.process_time() - began]


def find(folder: str, count: int, results: str) -> list[float]:
    """Find the stored runs of requests that are looked up already."""
    resolver = Resolver()
    runs = [resolver(spec) for spec in specs(folder, count)]
    stored_runs = LookUp(RunStore(results))
    began = time.process_time()
    assert None not in map(stored_runs.find, runs)
    return [time.process_time() - began]


def listing(folder: str, count: int, results: str) -> list[float]:
    """All rows of ``runs list``."""
    began = time.process_time()
    assert len(list_runs(RunStore(results))[0]) == count + 1
    return [time.process_time() - began]


def frame(folder: str, count: int, results: str) -> list[float]:
    """All runs as one pandas frame."""
    began = time.process_time()
    assert len(RunStore(results).frame()) == count + 1
    return [time.process_time() - began]


_CLUSTER = """
from distributed import LocalCluster
cluster = LocalCluster(n_workers={workers}, threads_per_worker=1, dashboard_address=None)
print(cluster.scheduler_address, flush=True)
input()
cluster.close()
"""


def on_workers(folder: str, workers: int, results: str) -> list[float]:
    """Runs of five frames on Dask's workers."""
    command = [sys.executable, "-c", _CLUSTER.format(workers=workers)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as cluster:
        with DaskWorkers(cluster.stdout.readline().strip()) as executor:
            # all are ready then
            run_many(still(folder, 5, range(-5 * workers, 0)), results=results, executor=executor)
            spent = time.process_time()
            began = time.monotonic()
            run_many(still(folder, 5, range(RUNS)), results=results, executor=executor)
        head_ms = 1000 * (time.process_time() - spent) / RUNS
        minutes = (time.monotonic() - began) / 60
        cluster.communicate("\n")
    return [head_ms, RUNS / minutes]


def of_frames(folder: str, frames: int, results: str) -> list[float]:
    """Runs of so many frames."""
    run_many(still(folder, frames, [-1]), results=results)  # the fork server has started then
    (server,) = psutil.Process().children()
    before = sum(server.cpu_times())
    spent = time.process_time()
    records = run_many(still(folder, frames, range(RUNS)), results=results)
    head = time.process_time() - spent
    other = sum(server.cpu_times()) - before
    files = list(RunStore(results).folder(records[0].run_id).iterdir())
    return [
        1000 * head / RUNS,
        1000 * other / RUNS,
        sum(file.stat().st_size for file in files) / 1000,
        len(files),
    ]


RUNS = 50
"""Runs of a row of the second and the third table."""


def still(folder: str, frames: int, seeds: Iterable[int]) -> list[RunSpec]:
    return [
        RunSpec(
            tracker="never-move",
            sequence=folder,
            frames=(0, frames),
            seed=seed % 10**6,
            device="cpu",
        )
        for seed in seeds
    ]


def with_peak(part: Callable[..., list[float]], *arguments: object) -> tuple[list[float], float]:
    """What a part measures, and the most memory of the process in MB."""
    return part(*arguments), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measured(part: Callable[..., list[float]], *arguments: object) -> tuple[list[float], float]:
    """`with_peak` in a process of its own."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(with_peak, part, *arguments).result()


def main() -> None:
    """Print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument("folder")
    parser.add_argument("--runs", type=int, nargs="+", default=[1000, 10_000, 100_000])
    options = parser.parse_args()
    folder = options.folder
    print(
        "| runs | none stored, s | resume, s | find, s | first list, s | later lists, s | frame, s | most memory, MB |"
    )
    print("| --- " * 8 + "|")
    for count in options.runs:
        with tempfile.TemporaryDirectory() as results:
            before = measured(look_up, folder, count, results)
            measured(fill, folder, count, results)
            after = [
                measured(part, folder, count, results)
                for part in (resume, find, listing, listing, frame)
            ]
        cells, peaks = zip(before, *after, strict=True)
        print(
            f"| {count} | {' | '.join(f'{cell:.2f}' for cell in chain(*cells))} | {max(peaks):.0f} |",
            flush=True,
        )
    print("\n| Dask's workers | head, ms a run | runs a minute |\n| --- | --- | --- |")
    for count in (1, 2, 4, 8):
        with tempfile.TemporaryDirectory() as results:
            (head_ms, a_minute), _ = measured(on_workers, folder, count, results)
        print(f"| {count} | {head_ms:.1f} | {a_minute:.0f} |", flush=True)
    print(
        "\n| frames | head, ms a run | other processes, ms a run | kB a run | files a run |\n"
        + "| --- " * 5
        + "|"
    )
    for count in (5, 50, 200):
        with tempfile.TemporaryDirectory() as results:
            cells, _ = measured(of_frames, folder, count, results)
        print(f"| {count} | {' | '.join(f'{cell:.0f}' for cell in cells)} |", flush=True)


if __name__ == "__main__":
    main()
