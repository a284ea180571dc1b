"""`python -m tests.fuzz`: attack every reader for a while, and record what came of it."""

from __future__ import annotations

import argparse
import hashlib
import json
import logging
import math
import multiprocessing
import os
import sys
import time
from collections.abc import Iterator
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import cv2
import torch

from .campaign import attack
from .readers import TARGETS
from .target import Target


def _all(
    targets: list[Target], jobs: int, seconds: float, inputs: float, seed: int, findings: Path
) -> Iterator[dict[str, Any]]:
    """Each reader in a process of its own: its peak of memory is its own, and a crash of native code is a finding."""
    findings.mkdir(parents=True, exist_ok=True)
    running: dict[int, tuple[Target, Path, Any]] = {}
    waiting = list(targets)
    while waiting or running:
        while waiting and len(running) < jobs:
            target = waiting.pop(0)
            said = findings / f".{target.name.replace(' ', '-')}.{os.getpid()}.json"
            child = multiprocessing.get_context("fork").Process(
                target=_job, args=(target, seconds, inputs, seed, findings, said), daemon=True
            )
            child.start()
            running[child.sentinel] = target, said, child
        for sentinel in wait(list(running)):
            target, said, child = running.pop(sentinel)  # type: ignore[arg-type]
            child.join()
            if child.exitcode == 0:
                yield json.loads(said.read_text())
                said.unlink()
            else:
                what = [f"its process ended with {child.exitcode} (seed {seed})"]
                none = {"inputs": 0, "refused": 0, "seconds": 0, "code": "", "missed": [], "n_lines": 0}
                yield {"reader": target.name, **none, "findings": what}


def _job(target: Target, seconds: float, inputs: float, seed: int, findings: Path, said: Path) -> None:
    logging.disable(logging.CRITICAL)
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libpng and libjpeg tell what they think of every file
    result = attack(target, seconds=seconds, inputs=inputs, seed=seed)
    for finding in result.findings:
        data = finding.data or b""
        (findings / f"{target.name.replace(' ', '-')}-{hashlib.sha256(data).hexdigest()[:8]}").write_bytes(data)
    found = {
        "reader": target.name,
        "inputs": result.inputs,
        "refused": result.refused,
        "seconds": time.process_time(),
        "code": result.coverage.code,
        "missed": result.coverage.missed,
        "n_lines": len(result.coverage.lines),
        "findings": [finding.what for finding in result.findings],
    }
    said.write_text(json.dumps(found))


def main() -> int:
    """Attack, print a table, add the figures to a record if one is named; 1 if anything escaped."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0, help="processor time of all readers together")
    parser.add_argument("--inputs", type=float, default=math.inf, help="of each reader; the time may end it before")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seed", type=int, default=int(time.time()), help="of the damage; another one every time")
    parser.add_argument("--reader", action="append", help="only this reader; repeatable")
    parser.add_argument(
        "--findings", type=Path, default=Path("/tmp/dynslam-fuzz"), help="inputs that escaped are kept there"
    )
    parser.add_argument("--record", type=Path, help="JSON file whose figures are added to")
    options = parser.parse_args()
    chosen = [target for target in TARGETS if not options.reader or target.name in options.reader]
    seconds = 60 * options.minutes / len(chosen)
    rows = []
    for found in _all(chosen, options.jobs, seconds, options.inputs, options.seed, options.findings):
        row = _add(options.record, found)  # at once: a campaign that is ended early is not lost
        rows.append(row)
        sys.stdout.write(
            f"{row['reader']:32s} {row['inputs']:9d} inputs  {100 * row['coverage']:5.1f} % of {row['n_lines']} lines  "
            f"{'; '.join(row['findings'])}\n"
        )
        sys.stdout.flush()
    sys.stdout.write(f"{sum(row['inputs'] for row in rows)} inputs, {len(rows)} readers\n")
    return int(any(row["findings"] for row in rows))


def _add(record: Path | None, found: dict[str, Any]) -> dict[str, Any]:
    """A reader's figures of this and, where a record is named, of all campaigns before it.

    Lines that ran count while the reader's code is the same. Findings of earlier campaigns are not repeated: they are
    tests by now.
    """
    before: dict[str, Any] = {}
    if record is not None and record.is_file():
        before = json.loads(record.read_text())
    readers = {row["reader"]: row for row in before.get("readers", [])}
    earlier = readers.get(found["reader"], {})
    if earlier.get("code") == found["code"]:
        found["missed"] = sorted({*found["missed"]} & {*earlier["missed"]})
    row = {
        "reader": found["reader"],
        "inputs": found["inputs"] + earlier.get("inputs", 0),
        "refused": found["refused"] + earlier.get("refused", 0),
        "coverage": round(1 - len(found["missed"]) / max(found["n_lines"], 1), 4),
        **{name: found[name] for name in ("n_lines", "missed", "code", "findings")},
    }
    if record is not None:
        readers[found["reader"]] = row
        inputs = sum(each["inputs"] for each in readers.values())
        seconds = round(before.get("processor_seconds", 0) + found["seconds"])
        total = {"inputs": inputs, "processor_seconds": seconds, "readers": [*readers.values()]}
        record.write_text(json.dumps(total, indent=1) + "\n")
    return row


if __name__ == "__main__":
    sys.exit(main())
