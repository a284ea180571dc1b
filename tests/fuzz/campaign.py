"""A reader to attack, and the attack: damaged files for a while, and what escaped."""

import io
import resource
import signal
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random

from dynslam_bench.core.errors import DynslamError

from .mutate import mutate

Mutation = Callable[[bytes, Random], bytes]


@dataclass(frozen=True)
class Target:
    """A reader.

    Attributes:
        name: Its name.
        read: Reads what the bytes are in an empty folder of its own; None stands for a file that is missing. It ends,
            or raises an error of `allowed`; anything else is a finding.
        seeds: Makes sound and unsound files, once.
        mutation: Damage that keeps checksums or syntax right, used every other time beside damage to plain bytes.
        allowed: The errors that its documentation names.
    """

    name: str
    read: Callable[[bytes | None, Path], object]
    seeds: Callable[[], list[bytes]]
    mutation: Mutation | None = None
    allowed: tuple[type[BaseException], ...] = (DynslamError,)


def written(write: Callable[[io.BytesIO], object]) -> bytes:
    """What a function writes to a file."""
    buffer = io.BytesIO()
    write(buffer)
    return buffer.getvalue()


def at(folder: Path, name: str, data: bytes | None) -> Path:
    """A file of that name with the bytes, or its path where there are none."""
    path = folder / name
    if data is None:
        path.unlink(missing_ok=True)
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return path


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
        seed: Of the damage.

    Returns:
        What escaped, with the input, one of a kind.
    """
    random, corpus = Random(f"{target.name} {seed}"), target.seeds()
    first: list[bytes | None] = [*corpus, None, b"", b"\xff\xfe\x00", b"{}", b"[" * 100_000]
    findings: dict[str, bytes | None] = {}
    peak = _peak_mb()
    for number in range(inputs):
        data = first[number] if number < len(first) else _damaged(target, corpus, random)
        fault = _one(target, data)
        before, peak = peak, _peak_mb()
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
    began, fault = time.process_time(), ""
    signal.signal(signal.SIGPROF, _hangs)
    signal.setitimer(signal.ITIMER_PROF, HANGS_S)
    try:
        with tempfile.TemporaryDirectory(prefix="dynslam-fuzz-", dir=_MEMORY, ignore_cleanup_errors=True) as folder:
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
