"""Resumable download of one file over HTTP."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import http.client
import json
import shutil
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .download_progress import Progress, Report, reporting
from .errors import DownloadError
from .locks import claimed

__all__ = ["CHUNK", "Progress", "Report", "download", "file_sha256", "forget"]

CHUNK = 1 << 18


def download(
    url: str,
    target: Path,
    *,
    sha256: str | None = None,
    progress: Report | None = None,
    attempts: int = 6,
    wait_s: float = 1.0,
    timeout_s: float = 30.0,
) -> str:
    """Download a file; what an earlier call got is kept, and the download goes on where that stopped.

    The bytes gather in ``<target>.part``; `target` appears only when it is whole and its checksum fits.

    Args:
        url: An ``http`` or ``https`` address.
        target: The file to write.
        sha256: Expected checksum, or its first digits; None if it is not known.
        progress: Called with the bytes done; None leaves that to what `download_progress.show_downloads` was given.
        attempts: Connections in a row that may fail without bringing a single byte.
        wait_s: Pause before the second attempt, doubled before each further one.
        timeout_s: How long a connection may be silent.

    Returns:
        SHA-256 of the file.

    Raises:
        DownloadError: The server cannot be reached, refuses, or announces another length than it sends; the disk is
            full; the checksum is wrong (then the bytes are thrown away), or another process downloads the same file.
    """
    if not url.startswith(("http://", "https://")):
        raise DownloadError(f"cannot download {url}", "the address has to begin with http:// or https://")
    part = target.with_name(target.name + ".part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DownloadError(f"cannot write into {target.parent}: {error.strerror}", "name another folder") from error
    try:
        with _only_one(part.with_name(part.name + ".lock"), url), reporting(target.name, progress) as report:
            here = target if target.is_file() else part
            if here is part:
                _complete(url, part, report, attempts, wait_s, timeout_s)
            found = file_sha256(here, report)
            if sha256 is not None and not found.startswith(sha256):
                size = here.stat().st_size
                here.unlink()
                forget(part)
                raise DownloadError(
                    f"{url} has the checksum {found} ({size} bytes), expected {sha256}",
                    "the bytes were thrown away; fetch again, or skip the checksum if the publisher changed the file",
                )
            if here is part:
                part.replace(target)
            forget(part)  # also what a process left that was killed between these two lines
            return found
    except OSError as error:
        raise DownloadError(f"cannot write {target}: {error.strerror}", "make room, or name another folder") from error


def forget(part: Path) -> None:
    """Remove a partial download and its notes."""
    part.unlink(missing_ok=True)
    _notes(part).unlink(missing_ok=True)


def file_sha256(path: Path, progress: Report | None = None) -> str:
    """SHA-256 of a file."""
    total, done, value = path.stat().st_size, 0, hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            value.update(block)
            done += len(block)
            if progress is not None:
                progress(Progress("check", done, total))
    return value.hexdigest()


def _complete(url: str, part: Path, report: Report, attempts: int, wait_s: float, timeout_s: float) -> None:
    """Connect until the partial file is whole."""
    fruitless, pause, reason, best = 0, wait_s, "", _size(part)
    while fruitless < attempts:
        try:
            if _one_connection(url, part, report, timeout_s):
                return
            reason = "the server closed the connection early"
        except urllib.error.HTTPError as error:
            if error.code < 500 and error.code not in (408, 429):
                raise DownloadError(f"the server answers {error.code} {error.reason} for {url}") from error
            reason = f"the server answers {error.code} {error.reason}"
        except (OSError, http.client.HTTPException) as error:  # no route, time-out, reset, TLS
            reason = str(getattr(error, "reason", "") or error) or type(error).__name__
        if _size(part) > best:
            fruitless, pause, best = 0, wait_s, _size(part)
            continue
        fruitless += 1
        if fruitless < attempts:
            time.sleep(pause)
            pause = min(2 * pause, 30.0)
    announced = _read_notes(part).get("total")
    expected = f" of {announced}" if announced else ""
    raise DownloadError(
        f"download of {url} stopped at {_size(part)}{expected} bytes: {reason}",
        "run the same command again, it goes on from there",
    )


def _one_connection(url: str, part: Path, report: Report, timeout_s: float) -> bool:
    """One request from where the partial file ends; True if the file is whole afterwards."""
    start, notes = _size(part), _read_notes(part)
    if start and notes.get("url") != url:
        forget(part)
        start, notes = 0, {}
    request = urllib.request.Request(url, headers={"User-Agent": "dynslam-bench", "Accept-Encoding": "identity"})
    if start:
        request.add_header("Range", f"bytes={start}-")
        if validator := notes.get("etag") or notes.get("modified"):
            request.add_header("If-Range", validator)
    try:
        response = urllib.request.urlopen(request, timeout=timeout_s)
    except urllib.error.HTTPError as error:
        if error.code != 416 or not start:
            raise
        if _total(error.headers.get("Content-Range")) == start:
            return True
        forget(part)  # longer than the file on the server, or the server does not say: begin anew
        return False
    with response:
        if start and (response.status != 206 or not _continues(response.headers.get("Content-Range"), start)):
            if response.status == 206:  # a range, but not the one that was asked for
                forget(part)
                return False
            start = 0  # the whole file comes: the server knows no ranges, or the file has changed
        length = response.headers.get("Content-Length")
        total = start + int(length) if length is not None and length.isdigit() else None
        _write_notes(part, url, total, response.headers)
        _check_space(part, total, start)
        return _receive(response, part, start, total, report)


def _receive(response: Any, part: Path, start: int, total: int | None, report: Report) -> bool:
    """Append the body to the partial file; True if it came to its announced end."""
    done = start
    try:
        with part.open("r+b" if start else "wb") as file:
            file.seek(start)
            while True:
                try:
                    block = response.read1(CHUNK)
                except http.client.IncompleteRead as error:
                    file.write(error.partial)
                    return False
                if not block:
                    return total is None or done == total
                file.write(block)
                done += len(block)
                report(Progress("download", done, total))
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS, errno.EIO):
            raise
        raise DownloadError(
            f"cannot write {part} at {done} of {total if total is not None else 'unknown'} bytes: {error.strerror}",
            "make room and run the same command again, it goes on from there",
        ) from error


def _check_space(part: Path, total: int | None, start: int) -> None:
    free = shutil.disk_usage(part.parent).free
    if total is not None and total - start > free:
        raise DownloadError(
            f"{part.parent} has {free / 1e9:.2f} GB free, but {(total - start) / 1e9:.2f} GB are still to download",
            "make room, or name another folder",
        )


@contextlib.contextmanager
def _only_one(lock: Path, url: str) -> Iterator[None]:
    with claimed(lock) as mine:
        if not mine:
            raise DownloadError(f"another process is downloading {url}", "wait for it, then run the same command again")
        yield


def _continues(content_range: str | None, start: int) -> bool:
    return content_range is not None and content_range.startswith(f"bytes {start}-")


def _total(content_range: str | None) -> int | None:
    """The length in ``bytes */123`` or ``bytes 5-9/123``."""
    total = (content_range or "").rpartition("/")[2]
    return int(total) if total.isdigit() else None


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def _notes(part: Path) -> Path:
    return part.with_name(part.name + ".json")


def _read_notes(part: Path) -> dict[str, Any]:
    try:
        notes = json.loads(_notes(part).read_text())
    except (OSError, ValueError):
        return {}
    return notes if isinstance(notes, dict) else {}


def _write_notes(part: Path, url: str, total: int | None, headers: Any) -> None:
    etag = headers.get("ETag")
    notes = {
        "url": url,
        "total": total,
        "etag": None if etag is None or etag.startswith("W/") else etag,  # a weak one cannot validate a range
        "modified": headers.get("Last-Modified"),
    }
    with contextlib.suppress(OSError):  # without notes the next call begins anew, which is safe
        _notes(part).write_text(json.dumps(notes))
