"""Make the tables of `slam_hpo`: runs of dynslam-bench at Sobol's points, one Parquet file for each system.

    # a suite of the first 32 configurations
    python make_table.py suite mask-rcnn 0 32 > suite.toml
    # its runs, on as many machines as you like
    dynslam-bench bench suite.toml --shard 1/4 --results part1
    # the table
    python make_table.py table mask-rcnn part1 part2 part3 part4

A table may grow: later points of the sequence are added, and what is stored is not run again.
"""

import json
import sys
from pathlib import Path
from typing import Any

import pandas as pd
from scipy.stats import qmc
from slam_hpo.real import evaluated
from slam_hpo.spaces import FRAMES, SEQUENCES, SPACES, STARTS, STRIDE

from dynslam_bench.runs import RunStore

DATA = Path(__file__).parent / "slam_hpo" / "data"
POINTS = 2048
"""Length of Sobol's sequence that the configurations are taken from."""


def suite(system: str, first: str, count: str) -> str:
    """A suite of the default configuration and some of Sobol's points, as TOML."""
    space = SPACES[system]
    points = qmc.Sobol(len(space), seed=0).random(POINTS)[int(first) : int(first) + int(count)]
    lines = [
        'name = "slam-hpo"',
        f"trackers = {json.dumps([system])}",
        "cache = true",
        f"sequences = {json.dumps(SEQUENCES)}",
        f"offsets = {json.dumps(STARTS)}",
        f"stride = {STRIDE}",
        f"frames = [0, {max(STARTS) + STRIDE * max(FRAMES)}]",
    ]
    for point in points:
        values = ((name, space[name].at(unit)) for name, unit in zip(space, point, strict=True))
        settings = ", ".join(f"{json.dumps(name)} = {value}" for name, value in values)
        lines += ["", "[[rows]]", f"tracker = {json.dumps(system)}", f"settings = {{ {settings} }}"]
    return "\n".join(lines)


def table(system: str, *folders: str) -> str:
    """Write the Parquet file of a system from results folders."""
    # a row for each run and fidelity: shorter runs are the beginnings of the stored ones
    rows: list[dict[str, Any]] = []
    for folder in folders:
        store = RunStore(folder)
        records, unreadable = store.all()
        if unreadable:
            raise SystemExit(f"error: {unreadable[0]}")
        for record in records:
            if record.tracker.id != system:
                continue
            sequence = next(name for name in SEQUENCES if record.sequence.id.startswith(name))
            key_of_run = {name: record.settings[name] for name in SPACES[system]}
            key_of_run |= {"sequence": sequence, "start": record.offset}
            for length in FRAMES:
                evaluation = evaluated(store, record, length)
                rows.append(key_of_run | {"frames": length} | evaluation._asdict())
    data = (
        pd.DataFrame(rows)
        .drop(columns="log_ate_std")
        .astype({"sequence": "category", "status": "category"})
    )
    key = [*SPACES[system], "sequence", "start", "frames"]
    # the default may be there several times
    data = data.drop_duplicates(key).sort_values(key, ignore_index=True)
    data = data.astype({name: "float32" for name in ("ate_m", "coverage", "processor_s")})
    data.to_parquet(DATA / f"{system.partition('?')[0]}.parquet", compression="zstd", index=False)
    return f"{len(data)} rows\n"


if __name__ == "__main__":
    command, *arguments = sys.argv[1:]
    sys.stdout.write({"suite": suite, "table": table}[command](*arguments))
