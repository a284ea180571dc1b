"""What is attacked: a reader, and files that it reads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random

from dynslam_bench.core.errors import DynslamError

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


def at(folder: Path, name: str, data: bytes | None) -> Path:
    """A file of that name with the bytes, or its path where there are none."""
    path = folder / name
    if data is None:
        path.unlink(missing_ok=True)
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return path
