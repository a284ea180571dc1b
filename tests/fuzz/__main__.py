"""`python -m tests.fuzz`: attack every reader for a while, and record what came of it."""

from __future__ import annotations

import argparse
import hashlib
import json
import logging
import multiprocessing
import os
import sys
import time
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from .campaign import attack
from .readers import TARGETS
from .target import Target


def _all(targets: list[Target], jobs: int, seconds: float, seed: int, findings: Path) -> list[dict[str, Any]]:
    """Each reader in a process of its own: its peak of memory is its own, and a crash of native code is a finding."""
    findings.mkdir(parents=True, exist_ok=True)
    running: dict[int, tuple[Target, Path, Any]] = {}
    found: list[dict[str, Any]] = []
    waiting = list(targets)
    while waiting or running:
        while waiting and len(running) < jobs:
            target = waiting.pop(0)
            said = findings / f".{target.name.replace(' ', '-')}.{os.getpid()}.json"
            child = multiprocessing.get_context("fork").Process(
                target=_job, args=(target, seconds, seed, findings, said)
            )
            child.start()
            running[child.sentinel] = target, said, child
        for sentinel in wait(list(running)):
            target, said, child = running.pop(sentinel)  # type: ignore[arg-type]
            child.join()
            if child.exitcode == 0:
                found.append(json.loads(said.read_text()))
                said.unlink()
            else:
                what = [f"its process ended with {child.exitcode} (seed {seed})"]
                found.append(dict(reader=target.name, inputs=0, refused=0, seen=[], lines=[], findings=what))
    return found


def _job(target: Target, seconds: float, seed: int, findings: Path, said: Path) -> None:
    logging.disable(logging.CRITICAL)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libpng and libjpeg tell what they think of every file
    result = attack(target, seconds=seconds, seed=seed)
    for finding in result.findings:
        data = finding.data or b""
        (findings / f"{target.name.replace(' ', '-')}-{hashlib.sha256(data).hexdigest()[:8]}").write_bytes(data)
    found = {
        "reader": target.name,
        "inputs": result.inputs,
        "refused": result.refused,
        "seen": sorted(result.coverage.seen),
        "lines": sorted(result.coverage.lines),
        "findings": [finding.what for finding in result.findings],
    }
    said.write_text(json.dumps(found))


def main() -> int:
    """Attack, print a table, add the figures to a record if one is named; 1 if anything escaped."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0, help="wall time of all readers together")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seed", type=int, default=int(time.time()), help="of the damage; another one every time")
    parser.add_argument("--reader", action="append", help="only this reader; repeatable")
    parser.add_argument(
        "--findings", type=Path, default=Path("/tmp/dynslam-fuzz"), help="inputs that escaped are kept there"
    )
    parser.add_argument("--record", type=Path, help="JSON file whose figures are added to")
    options = parser.parse_args()
    chosen = [target for target in TARGETS if not options.reader or target.name in options.reader]
    seconds = 60 * options.minutes * options.jobs / len(chosen)
    began = time.monotonic()
    found = _all(chosen, options.jobs, seconds, options.seed, options.findings)
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
