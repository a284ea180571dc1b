"""Attack a reader for a while, and say what escaped it."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import tempfile
import time
import traceback
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from .lines import Coverage
from .mutate import mutate
from .target import Target

MOST_MB = 512
"""One input may not take more memory than this, whatever it claims to be."""
HUNGRY = f"takes more than {MOST_MB} MB"
MOST_S = 5.0
"""Nor more processor time."""
HANGS_S = 30.0
"""Processor time after which an input is given up."""
LONGEST_MESSAGE = 2100
WATCHED = 16
"""Every so many inputs the lines are counted and the memory is asked for (which may take longer than the reading)."""
LARGEST_SEED = 1 << 16
"""An input that reaches new lines joins the seeds if it is no longer than this: damage to long ones is slow."""


@dataclass
class Finding:
    """An input that a reader did not take as it should."""

    target: str
    what: str
    data: bytes | None


@dataclass
class Result:
    """What came of one reader.

    Attributes:
        target: Its name.
        inputs: Inputs that were read.
        refused: How many of them ended in a documented error; all others were read.
        coverage: Lines of the reader that ran.
        findings: What escaped, one of a kind.
    """

    target: str
    inputs: int
    refused: int
    coverage: Coverage
    findings: list[Finding] = field(default_factory=list)


def attack(target: Target, *, seconds: float = float("inf"), inputs: float = float("inf"), seed: int = 0) -> Result:
    """Read damaged files until the time or the number is reached; the seeds and a missing file come first.

    Args:
        target: The reader.
        seconds: Processor time.
        inputs: Number of inputs.
        seed: Of the damage.
    """
    random = Random(f"{target.name} {seed}")
    result = Result(target.name, 0, 0, Coverage(target.covers))
    folder = Path(tempfile.mkdtemp(prefix="dynslam-fuzz-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
    kinds: set[str] = set()
    try:
        corpus = target.seeds()
        first: list[bytes | None] = [*corpus, None, b"", b"\xff\xfe\x00", b"{}", b"[" * 100_000]
        end = time.process_time() + seconds
        recent: list[bytes | None] = []
        peak = _peak_mb()
        while result.inputs < inputs and (time.process_time() < end or result.inputs < len(first)):
            data = first[result.inputs] if result.inputs < len(first) else _damaged(target, corpus, random)
            watched = result.inputs < len(first) or result.inputs % WATCHED == 0
            new, fault, refused = _one(target, data, folder, result.coverage if watched else None)
            result.inputs += 1
            result.refused += refused
            if new and data is not None and len(data) <= LARGEST_SEED and len(corpus) < 200:
                corpus.append(data)
            recent.append(data)
            if watched:
                before, peak = peak, _peak_mb()
                if peak - before > MOST_MB:
                    data, fault = next((each for each in recent if _is_hungry(target, each, folder)), data), HUNGRY
                recent.clear()
            if fault and fault not in kinds:
                kinds.add(fault)
                result.findings.append(Finding(target.name, fault, data))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return result


def _damaged(target: Target, corpus: list[bytes], random: Random) -> bytes:
    data = random.choice(corpus)
    if target.mutation is not None and random.random() < 0.6:
        return target.mutation(data, random)
    return mutate(data, corpus, random)


def _one(target: Target, data: bytes | None, folder: Path, coverage: Coverage | None) -> tuple[bool, str, bool]:
    """Whether new lines ran, what escaped (empty for nothing), and whether the input was refused."""
    shutil.rmtree(folder)
    folder.mkdir()
    began, seen = time.process_time(), 0 if coverage is None else len(coverage.seen)
    refused, fault = False, ""
    signal.signal(signal.SIGPROF, _hangs)
    signal.setitimer(signal.ITIMER_PROF, HANGS_S)
    try:
        if coverage is None:
            target.read(data, folder)
        else:
            coverage.watch(lambda: target.read(data, folder))
    except target.allowed as error:
        refused = True
        if "\n" in str(error) or len(str(error)) > LONGEST_MESSAGE:
            fault = f"a message of {len(str(error))} characters or several lines"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        last = traceback.extract_tb(error.__traceback__)[-1]
        fault = f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    if not fault and time.process_time() - began > MOST_S:
        fault = f"takes more than {MOST_S:g} s"
    return coverage is not None and len(coverage.seen) > seen, fault, refused


def _is_hungry(target: Target, data: bytes | None, folder: Path) -> bool:
    """Whether an input alone takes too much memory: read again in a process of its own, whose peak is its own."""
    pid = os.fork()
    if pid == 0:
        before = _peak_mb()
        _one(target, data, folder, None)
        os._exit(int(_peak_mb() - before > MOST_MB))
    return os.waitpid(pid, 0)[1] != 0


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _hangs(*_: object) -> None:
    raise TimeoutError(f"no end within {HANGS_S:g} s")
