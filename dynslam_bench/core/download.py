"""Resumable download of one file over HTTP, bounded in size and time."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import http.client
import ipaddress
import json
import shutil
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from urllib.parse import SplitResult, urlsplit

from dynslam_bench.core.download_progress import Progress, Report, reporting
from dynslam_bench.core.errors import DownloadError, DynslamError
from dynslam_bench.core.files import claimed
from dynslam_bench.core.passwords import without_passwords
from dynslam_bench.core.reading import read_json

__all__ = ["CHUNK", "Progress", "Report", "download", "file_sha256", "forget"]

CHUNK = 1 << 18
MOST_BYTES = 32 * 2**30
DEADLINE_S = 24 * 3600.0


def download(
    url: str,
    target: Path,
    *,
    sha256: str | None = None,
    progress: Report | None = None,
    attempts: int = 6,
    wait_s: float = 1.0,
    timeout_s: float = 30.0,
    most_bytes: int = MOST_BYTES,
    deadline_s: float = DEADLINE_S,
) -> str:
    """Download a file; what an earlier call got is kept, and the download goes on where that stopped.

    The bytes gather in ``<target>.part``; `target` appears only when it is whole and its checksum fits.

    Args:
        url: An ``https`` address, or an ``http`` one where the checksum is known.
        target: The file to write.
        sha256: Expected checksum, or its first digits; None if it is not known.
        progress: Called with the bytes done; None leaves that to what `download_progress.show_downloads` was given.
        attempts: Connections in a row that may fail without bringing a single byte.
        wait_s: Pause before the second attempt, doubled before each further one.
        timeout_s: How long a connection may be silent.
        most_bytes: A longer file is refused.
        deadline_s: How long all of it may take.

    Returns:
        SHA-256 of the file.

    Raises:
        DownloadError: The address is none; the server cannot be reached, refuses, redirects to something else than the
            web, or announces another length than it sends; the file is too long or takes too long; the disk is full;
            the checksum is wrong (then the bytes are thrown away), or another process downloads the same file.
    """
    check_address(url, checked=sha256 is not None)
    part = target.with_name(target.name + ".part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DownloadError(f"cannot write into {target.parent}: {error.strerror}", "name another folder") from error
    bounds = _Bounds(most_bytes, time.monotonic() + deadline_s, deadline_s)
    try:
        with _only_one(part.with_name(part.name + ".lock"), url), reporting(target.name, progress) as report:
            here = target if target.is_file() else part
            if here is part:
                _complete(url, part, report, attempts, wait_s, timeout_s, bounds)
            found = file_sha256(here, report)
            if sha256 is not None and not found.startswith(sha256):
                raise _discard(here, part, f"{url} has the checksum {found}", sha256)
            if here is part:
                part.replace(target)
            forget(part)  # also what a process left that was killed between these two lines
            return found
    except OSError as error:
        raise DownloadError(f"cannot write {target}: {error.strerror or error}", "name another folder") from error


def _discard(here: Path, part: Path, what: str, expected: str) -> DownloadError:
    """Throw away bytes whose checksum is not the expected one."""
    size = here.stat().st_size
    here.unlink()
    forget(part)
    return DownloadError(
        f"{what} ({size} bytes), expected {expected}",
        "the bytes were thrown away; fetch again, or skip the checksum if the publisher changed the file",
    )


@dataclass(frozen=True)
class _Bounds:
    """How long a file may be, and until when it has to be here."""

    most_bytes: int
    deadline: float
    seconds: float

    def check(self, url: str, part: Path, size: int) -> None:
        """Refuse what is too long, and throw away what came of it; end what takes too long, and keep it."""
        if size > self.most_bytes:
            forget(part)
            raise DownloadError(f"{url} is longer than the {self.most_bytes / 1e9:.2f} GB that are expected, refused")
        if time.monotonic() > self.deadline:
            raise DownloadError(
                f"download of {url} stopped at {_size(part)} bytes: it took longer than {self.seconds:g} s",
                "run the same command again, it goes on from there",
            )


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


def _complete(
    url: str, part: Path, report: Report, attempts: int, wait_s: float, timeout_s: float, bounds: _Bounds
) -> None:
    """Connect until the partial file is whole."""
    fruitless, pause, reason, best = 0, wait_s, "", _size(part)
    while fruitless < attempts:
        bounds.check(url, part, _size(part))
        try:
            if _one_connection(url, part, report, timeout_s, bounds):
                return
            reason = "the server closed the connection early"
        except urllib.error.HTTPError as error:
            if error.code < 500 and error.code not in (408, 429):
                raise DownloadError(f"the server answers {error.code} {error.reason} for {url}") from error
            reason = f"the server answers {error.code} {error.reason}"
        except (OSError, http.client.HTTPException, ValueError) as error:  # no route, time-out, TLS, an odd redirect
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


def _one_connection(url: str, part: Path, report: Report, timeout_s: float, bounds: _Bounds) -> bool:
    """One request from where the partial file ends; True if the file is whole afterwards."""
    start, notes = _size(part), _read_notes(part)
    if start and notes.get("url") != without_passwords(url):
        forget(part)
        start, notes = 0, {}
    request = urllib.request.Request(url, headers={"User-Agent": "dynslam-bench", "Accept-Encoding": "identity"})
    if start:
        request.add_header("Range", f"bytes={start}-")
        if validator := notes.get("etag") or notes.get("modified"):
            request.add_header("If-Range", validator)
    try:
        response = connect(request, timeout_s)
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
        bounds.check(url, part, total or start)
        _check_space(part, total, start)
        return _receive(response, part, start, total, report, lambda size: bounds.check(url, part, size))


def _receive(
    response: Any, part: Path, start: int, total: int | None, report: Report, check: Callable[[int], None]
) -> bool:
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
                check(done + len(block))
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
    with contextlib.ExitStack() as held:
        try:
            mine = held.enter_context(claimed(lock))
        except DynslamError as error:
            raise DownloadError(str(error.args[0]), error.hint) from error
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
        notes = read_json(_notes(part))
    except DynslamError:
        return {}
    return notes if isinstance(notes, dict) else {}


def _write_notes(part: Path, url: str, total: int | None, headers: Any) -> None:
    etag = headers.get("ETag")
    notes = {
        "url": without_passwords(url),
        "total": total,
        "etag": None if etag is None or etag.startswith("W/") else etag,  # a weak one cannot validate a range
        "modified": headers.get("Last-Modified"),
    }
    with contextlib.suppress(OSError):  # without notes the next call begins anew, which is safe
        _notes(part).write_text(json.dumps(notes))


# Which web addresses are fetched from: https, or http where the content is checked, and nothing they redirect to else.


def check_address(url: str, *, checked: bool) -> SplitResult:
    """The parts of an address that may be fetched.

    Args:
        url: The address.
        checked: Whether a checksum of the content is known; then plain http will do, and on this machine always.

    Raises:
        DownloadError: Another scheme, no host, characters that no address has, or a password.
    """
    try:
        parts = urlsplit(url)
        host, port = (parts.hostname or "").encode("idna").decode(), parts.port
    except ValueError as error:
        raise DownloadError(f"cannot download {url[:200]!r}: {error}") from error
    if parts.scheme not in ("http", "https"):
        raise DownloadError(f"cannot download {url[:200]!r}", "the address has to begin with http:// or https://")
    if not host or port == 0 or not url.isascii() or not url.isprintable() or " " in url:
        raise DownloadError(f"cannot download {url[:200]!r}: it is no web address", "for example https://host/name.tgz")
    if parts.username is not None or parts.password is not None:
        raise DownloadError(f"cannot download from {host}: the address holds a name or password", "leave them out")
    if parts.scheme == "http" and not checked and not _is_here(host):
        raise DownloadError(
            f"cannot download {url[:200]!r}: http without a known checksum could bring anything", "use https"
        )
    return parts


def connect(request: urllib.request.Request, timeout_s: float) -> Any:
    """As the standard library opens an address, for http and https alone, whatever a server redirects to.

    Raises:
        DownloadError: The server redirects to another scheme.
        OSError: It cannot be reached, or answers with an error.
    """
    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler,
        urllib.request.HTTPHandler,
        urllib.request.HTTPSHandler,
        urllib.request.HTTPDefaultErrorHandler,
        urllib.request.HTTPErrorProcessor,
        _Redirect,
    ):
        opener.add_handler(handler())
    return opener.open(request, timeout=timeout_s)


class _Redirect(urllib.request.HTTPRedirectHandler):
    """Follows redirects to https, and from http to http."""

    def redirect_request(
        self, req: urllib.request.Request, fp: IO[bytes], code: int, msg: str, headers: Any, newurl: str
    ) -> urllib.request.Request | None:
        scheme = urlsplit(newurl).scheme
        if scheme != "https" and scheme != req.type:
            raise DownloadError(f"the server redirects {req.full_url} to {newurl[:200]!r}, refused", "name a mirror")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _is_here(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
