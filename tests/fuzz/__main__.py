"""`python -m tests.fuzz`: attack every reader for a while, and record what came of it."""

from __future__ import annotations

import argparse
import hashlib
import json
import logging
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from .campaign import attack
from .readers import TARGETS


def _job(name: str, seconds: float, seed: int, findings: str) -> dict[str, Any]:
    """One reader, in a process of its own: its peak of memory is its own, and a crash ends nothing else."""
    logging.disable(logging.CRITICAL)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libpng and libjpeg tell what they think of every file
    result = attack(next(target for target in TARGETS if target.name == name), seconds=seconds, seed=seed)
    for finding in result.findings:
        data = finding.data or b""
        file = Path(findings) / f"{name.replace(' ', '-')}-{hashlib.sha256(data).hexdigest()[:8]}"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)
    return {
        "reader": name,
        "inputs": result.inputs,
        "refused": result.refused,
        "seen": sorted(result.coverage.seen),
        "lines": sorted(result.coverage.lines),
        "findings": [finding.what for finding in result.findings],
    }


def main() -> int:
    """Attack, print a table, add the figures to a record if one is named; 1 if anything escaped."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0, help="wall time of all readers together")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seed", type=int, default=int(time.time()), help="of the damage; another one every time")
    parser.add_argument("--reader", action="append", help="only this reader; repeatable")
    parser.add_argument("--findings", default="/tmp/dynslam-fuzz", help="inputs that escaped are kept there")
    parser.add_argument("--record", type=Path, help="JSON file whose figures are added to")
    options = parser.parse_args()
    names = [target.name for target in TARGETS if not options.reader or target.name in options.reader]
    seconds = 60 * options.minutes * options.jobs / len(names)
    began = time.monotonic()
    with ProcessPoolExecutor(options.jobs, max_tasks_per_child=1) as pool:
        jobs = [pool.submit(_job, name, seconds, options.seed, options.findings) for name in names]
        found = [job.result() for job in jobs]
    rows = _add(options.record, found, time.monotonic() - began)
    for row in rows:
        sys.stdout.write(
            f"{row['reader']:32s} {row['inputs']:9d} inputs  {100 * row['coverage']:5.1f} % of {row['n_lines']} lines  "
            f"{'; '.join(row['findings'])}\n"
        )
    sys.stdout.write(f"{sum(row['inputs'] for row in rows)} inputs, {len(rows)} readers\n")
    return int(any(each["findings"] for each in found))


def _add(record: Path | None, found: list[dict[str, Any]], seconds: float) -> list[dict[str, Any]]:
    """The figures of this and, where a record is named, of all campaigns before it.

    Findings of earlier campaigns are not repeated: they are tests by now.
    """
    rows = []
    before: dict[str, Any] = {}
    if record is not None and record.is_file():
        before = json.loads(record.read_text())
    old = {row["reader"]: row for row in before.get("readers", [])}
    for each in found:
        share = len(each["seen"]) / max(len(each["lines"]), 1)
        missed = sorted(
            f"{Path(name).name}:{line}" for name, line in set(map(tuple, each["lines"])) - set(map(tuple, each["seen"]))
        )
        earlier = old.get(each["reader"], {})
        rows.append(
            {
                "reader": each["reader"],
                "inputs": each["inputs"] + earlier.get("inputs", 0),
                "refused": each["refused"] + earlier.get("refused", 0),
                "coverage": round(max(share, earlier.get("coverage", 0.0)), 4),
                "n_lines": len(each["lines"]),
                "missed": missed,
                "findings": each["findings"],
            }
        )
    if record is not None:
        kept = [row for row in before.get("readers", []) if row["reader"] not in {each["reader"] for each in rows}]
        total = {"seconds": round(before.get("seconds", 0) + seconds), "readers": [*kept, *rows]}
        record.write_text(json.dumps({"inputs": sum(r["inputs"] for r in total["readers"]), **total}, indent=1) + "\n")
    return rows


if __name__ == "__main__":
    sys.exit(main())
