"""Where network weights lie: in the package, in the user's cache, or at a published address. No torch in here."""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dynslam_bench.core.errors import SegmentationError

CACHE_VARIABLE = "DYNSLAM_BENCH_WEIGHTS"
EMBEDDED_NAME = "embedded.pt"
_BLOCK = 1 << 18

Progress = Callable[[int, int], None]
"""Called with the bytes received so far and the total (0 if unknown)."""


@dataclass(frozen=True)
class Checkpoint:
    """A published checkpoint.

    Attributes:
        id: Short name.
        file: Name in the cache.
        url: Where it is published.
        sha256_prefix: First digits of its SHA-256, as the publisher gives them in the file name.
        megabytes: Size, for messages.
        license: Of the weights.
        trained_on: Data set.
    """

    id: str
    file: str
    url: str
    sha256_prefix: str
    megabytes: int
    license: str
    trained_on: str


COCO = Checkpoint(
    "coco",
    "maskrcnn_resnet50_fpn_coco-bf2d0c1e.pth",
    "https://download.pytorch.org/models/maskrcnn_resnet50_fpn_coco-bf2d0c1e.pth",
    "bf2d0c1e",
    170,
    "BSD-3-Clause",
    "COCO train2017",
)


def weights_cache() -> Path:
    """The folder of downloaded weights: ``$DYNSLAM_BENCH_WEIGHTS``, else a folder in the user's cache."""
    if value := os.environ.get(CACHE_VARIABLE):
        return Path(value).expanduser()
    if value := os.environ.get("XDG_CACHE_HOME"):
        return Path(value).expanduser() / "dynslam-bench" / "weights"
    base = Path("~/Library/Caches" if sys.platform == "darwin" else "~/.cache").expanduser()
    return base / "dynslam-bench" / "weights"


def embedded_weights() -> Path | None:
    """The file of the network that comes with this package; None if this installation has none."""
    path = Path(__file__).parent / "weights" / EMBEDDED_NAME
    return path if path.is_file() else None


def cached_checkpoint(checkpoint: Checkpoint) -> Path | None:
    """The checkpoint's file in the cache, or None."""
    path = weights_cache() / checkpoint.file
    return path if path.is_file() else None


def fetch_checkpoint(checkpoint: Checkpoint, progress: Progress | None = None) -> Path:
    """The checkpoint's file, downloaded and verified if it is not in the cache yet.

    A broken or foreign download never gets the final name.

    Args:
        checkpoint: What to fetch.
        progress: Told how far the download is; None shows a bar on a terminal and nothing elsewhere.

    Raises:
        SegmentationError: No network, no space, or the content's SHA-256 does not begin as published; names the
            address, the size and the path under which the file may be put by hand.
    """
    path = weights_cache() / checkpoint.file
    if path.is_file():
        return path
    by_hand = f"put the file of {checkpoint.url} ({checkpoint.megabytes} MB) at {path}"
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{checkpoint.file}.", dir=path.parent)
        temporary = Path(name)
        with os.fdopen(handle, "wb") as file:
            found = _download(checkpoint, file.write, progress)
        if not found.startswith(checkpoint.sha256_prefix):
            raise SegmentationError(
                f"the download of {checkpoint.url} is damaged: SHA-256 {found[:16]}..., expected "
                f"{checkpoint.sha256_prefix}...", "try again, or " + by_hand
            )  # fmt: skip
        temporary.replace(path)
    except OSError as error:
        raise SegmentationError(f"cannot fetch the checkpoint '{checkpoint.id}': {error}", by_hand) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
    return path


def _download(checkpoint: Checkpoint, write: Callable[[bytes], object], progress: Progress | None) -> str:
    digest = hashlib.sha256()
    with urllib.request.urlopen(checkpoint.url, timeout=30) as response:
        total = int(response.headers.get("Content-Length") or 0)
        with _bar(checkpoint, total, progress) as report:
            done = 0
            while block := response.read(_BLOCK):
                write(block)
                digest.update(block)
                done += len(block)
                report(done, total)
    if total and done != total:
        raise OSError(f"the connection broke off after {done} of {total} bytes")
    return digest.hexdigest()


class _bar:
    """A rich progress bar on a terminal, or the caller's function."""

    def __init__(self, checkpoint: Checkpoint, total: int, progress: Progress | None) -> None:
        self._report = progress
        if progress is None and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, DownloadColumn, Progress, TimeRemainingColumn, TransferSpeedColumn

            columns = ("[progress.description]{task.description}", BarColumn(), DownloadColumn(),
                       TransferSpeedColumn(), TimeRemainingColumn())  # fmt: skip
            self._rich: Progress | None = Progress(*columns, console=Console(stderr=True), transient=True)
            self._task = self._rich.add_task(f"weights '{checkpoint.id}'", total=total or None)
        else:
            self._rich = None

    def __enter__(self) -> Progress:
        if self._rich is not None:
            self._rich.start()
        return self._tell

    def __exit__(self, *_: object) -> None:
        if self._rich is not None:
            self._rich.stop()

    def _tell(self, done: int, total: int) -> None:
        if self._report is not None:
            self._report(done, total)
        elif self._rich is not None:
            self._rich.update(self._task, completed=done)
