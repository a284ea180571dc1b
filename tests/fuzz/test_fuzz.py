"""A short round against every reader; ``FUZZ_INPUTS=20000 FUZZ_SEED=1`` in the environment make a long one."""

import json
import os
import resource
import signal
import tempfile
import time
import traceback
from pathlib import Path
from random import Random

import pytest

from .mutate import mutate
from .targets import TARGETS, Target

pytestmark = pytest.mark.slow

INPUTS = int(os.environ.get("FUZZ_INPUTS", "60"))
SEED = int(os.environ.get("FUZZ_SEED", "0"))
MOST_MB = 512
"""One input may not take more memory than this, whatever it claims to be."""
MOST_S = 5.0
"""Nor more processor time."""
HANGS_S = 30.0
"""Processor time after which an input is given up."""
LONGEST_MESSAGE = 2100
_MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None
"""Where folders are made."""


def attack(target: Target, inputs: int, seed: int = 0) -> dict[str, bytes | None]:
    """Read so many files, of which the seeds and a missing one come first.

    Args:
        target: The reader.
        inputs: Number of inputs.
        seed: Seed of the damage.

    Returns:
        What escaped, with the input, one of a kind.
    """
    random = Random(f"{target.name} {seed}")
    corpus = target.seeds()
    first: list[bytes | None] = [*corpus, None, b"", b"\xff\xfe\x00", b"{}", b"[" * 100_000]
    findings: dict[str, bytes | None] = {}
    peak = _peak_mb()
    for number in range(inputs):
        data = first[number] if number < len(first) else _damaged(target, corpus, random)
        fault = _one(target, data)
        before = peak
        peak = _peak_mb()
        if peak - before > MOST_MB:
            fault = f"takes more than {MOST_MB} MB"
        if fault:
            findings.setdefault(fault, data)
    return findings


def _damaged(target: Target, corpus: list[bytes], random: Random) -> bytes:
    data = random.choice(corpus)
    if target.mutation is not None and random.random() < 0.6:
        return target.mutation(data, random)
    return mutate(data, corpus, random)


def _one(target: Target, data: bytes | None) -> str:
    """What escaped; empty for nothing."""
    began = time.process_time()
    fault = ""
    signal.signal(signal.SIGPROF, _hangs)
    signal.setitimer(signal.ITIMER_PROF, HANGS_S)
    try:
        with tempfile.TemporaryDirectory(
            prefix="dynslam-fuzz-", dir=_MEMORY, ignore_cleanup_errors=True
        ) as folder:
            target.read(data, Path(folder))
    except target.allowed as error:
        if "\n" in str(error) or len(str(error)) > LONGEST_MESSAGE:
            fault = f"a message of {len(str(error))} characters or several lines"
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        fault = f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    if not fault and time.process_time() - began > MOST_S:
        fault = f"takes more than {MOST_S:g} s"
    return fault


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _hangs(*_: object) -> None:
    raise TimeoutError(f"no end within {HANGS_S:g} s")


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_damaged_files_end_in_documented_errors(target: Target) -> None:
    assert attack(target, INPUTS, SEED) == {}


def test_a_reader_that_lets_errors_out_is_found_out() -> None:
    """The round itself: a raw error and a long message do not pass."""

    def read(data: bytes | None, folder: Path) -> None:
        json.loads(data or b"{}")

    findings = attack(Target("bare", read, lambda: [b'{"a": [1, 2]}']), 60)
    assert {finding.split()[0] for finding in findings} >= {"JSONDecodeError", "RecursionError"}
