"""`python -m tests.fuzz`: attack every reader for a while, and print what came of it."""

from __future__ import annotations

import argparse
import hashlib
import logging
import multiprocessing
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from .campaign import Result, attack
from .test_fuzz import TARGETS


def _job(number: int, seconds: float, seed: int, findings: Path) -> Result:
    """One reader, in a process of the pool: a crash of native code is a finding."""
    logging.disable(logging.CRITICAL)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libpng and libjpeg comment on every file
    result = attack(TARGETS[number], seconds=seconds, seed=seed)
    for data in result.findings.values():
        name = f"{TARGETS[number].name.replace(' ', '-')}-{hashlib.sha256(data or b'').hexdigest()[:8]}"
        (findings / name).write_bytes(data or b"")
    return result


def main() -> int:
    """Attack and print a line a reader; 1 if anything escaped."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0, help="processor time of all readers together")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seed", type=int, default=int(time.time()), help="of the damage; another one every time")
    parser.add_argument("--reader", action="append", help="only this reader; repeatable")
    parser.add_argument(
        "--findings", type=Path, default=Path("/tmp/dynslam-fuzz"), help="inputs that escaped are kept there"
    )
    options = parser.parse_args()
    options.findings.mkdir(parents=True, exist_ok=True)
    chosen = [number for number, target in enumerate(TARGETS) if not options.reader or target.name in options.reader]
    seconds = 60 * options.minutes / len(chosen)
    inputs, escaped = 0, False
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(options.jobs, context) as pool:
        jobs = {
            pool.submit(_job, number, seconds, options.seed, options.findings): TARGETS[number].name
            for number in chosen
        }
        for job in as_completed(jobs):
            try:
                result = job.result()
            except BrokenProcessPool as error:
                result = Result(findings={f"its process ended: {error}": None})
            inputs += result.inputs
            escaped |= bool(result.findings)
            findings = "; ".join(result.findings)
            print(f"{jobs[job]:32s} {result.inputs:9d} inputs, {result.refused:9d} refused  {findings}", flush=True)
    print(f"{inputs} inputs, {len(chosen)} readers, seed {options.seed}")
    return int(escaped)


if __name__ == "__main__":
    sys.exit(main())
