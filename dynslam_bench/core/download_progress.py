"""Who is told how far a download is; light, so that the command line can say so before it downloads anything."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Progress:
    """How far a fetch is.

    Attributes:
        stage: What is being done.
        done: Bytes done, those of earlier calls included.
        total: Bytes in all; None if the server does not say.
    """

    stage: Literal["download", "check", "extract"]
    done: int
    total: int | None


Report = Callable[[Progress], None]
Shown = Callable[[str], contextlib.AbstractContextManager[Report]]
"""Draws the download of a file of that name as long as the context lasts."""
_shown: list[Shown] = []
"""The one that `show_downloads` was given, if any."""


def show_downloads(shown: Shown) -> None:
    """Let this process draw every download on which nobody else reports; the command line does so."""
    _shown[:] = [shown]


@contextlib.contextmanager
def reporting(name: str, progress: Report | None) -> Iterator[Report]:
    """What to tell of a file's download: `progress`, else what draws downloads in this process, else nobody."""
    if progress is not None:
        yield progress
    elif _shown:
        with _shown[0](name) as report:
            yield report
    else:
        yield lambda _: None
