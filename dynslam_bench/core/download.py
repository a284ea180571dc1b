"""Resumable download of one file over HTTP, bounded in size and time.

Nothing heavy is imported before something is downloaded.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from dynslam_bench.core.errors import DownloadError, DynslamError
from dynslam_bench.core.files import claimed
from dynslam_bench.core.reading import read_json
from dynslam_bench.core.sanitise import without_passwords

if TYPE_CHECKING:
    from urllib.parse import SplitResult
    from urllib.request import Request


CHUNK = 1 << 18
MOST_BYTES = 32 * 2**30
DEADLINE_S = 24 * 3600.0
_LONGEST_PAUSE_S = 30.0
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS, errno.EIO)
_GO_ON = "run the same command again, it goes on from there"


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
Display = Callable[[str], contextlib.AbstractContextManager[Report]]
"""Shows the download of a file of that name as long as the context lasts."""
_display: list[Display] = []


def show_downloads(display: Display) -> None:
    """Let this process show every download that is called without `progress`; the command line does so."""
    _display[:] = [display]


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
        progress: Called with the bytes done; None leaves that to what `show_downloads` was given.
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
        with contextlib.ExitStack() as stack:
            if not stack.enter_context(_claimed(part.with_name(part.name + ".lock"))):
                raise DownloadError(
                    f"another process is downloading {url}", "wait for it, then run the same command again"
                )
            if progress is None:
                progress = stack.enter_context(_display[0](target.name)) if _display else lambda _: None
            partial = _Partial(url, part, progress, timeout_s, most_bytes, deadline_s)
            whole = target.is_file()
            if not whole:
                partial.complete(attempts, wait_s)
            checksum = file_sha256(target if whole else part, progress)
            if sha256 is not None and not checksum.startswith(sha256):
                size = (target if whole else part).stat().st_size
                target.unlink(missing_ok=True)
                partial.forget()
                raise DownloadError(
                    f"{url} has the checksum {checksum} ({size} bytes), expected {sha256}",
                    "the bytes were thrown away; fetch again, or skip the checksum if the publisher changed the file",
                )
            if not whole:
                part.replace(target)
            partial.forget()  # also what a process left that was killed between these two lines
            return checksum
    except OSError as error:
        raise DownloadError(f"cannot write {target}: {error.strerror or error}", "name another folder") from error


@contextlib.contextmanager
def _claimed(lock: Path) -> Iterator[bool]:
    with contextlib.ExitStack() as stack:
        try:
            mine = stack.enter_context(claimed(lock))
        except DynslamError as error:
            raise DownloadError(str(error.args[0]), error.hint) from error
        yield mine


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


class _Partial:
    """A partial download with its notes: where it came from, its length, and what the server calls that version."""

    def __init__(
        self, url: str, part: Path, report: Report, timeout_s: float, most_bytes: int, deadline_s: float
    ) -> None:
        self.url, self.part, self.report, self.timeout_s = url, part, report, timeout_s
        self.most_bytes, self.deadline_s = most_bytes, deadline_s
        self._notes = part.with_name(part.name + ".json")
        self._end = time.monotonic() + deadline_s

    def complete(self, attempts: int, wait_s: float) -> None:
        """Connect until the file is whole.

        Raises:
            DownloadError: It does not become so.
        """
        import http.client
        import urllib.error

        fruitless, pause_s, best, reason = 0, wait_s, self._size(), ""
        while fruitless < attempts:
            self._check(self._size())
            try:
                if self._connect():
                    return
                reason = "the server closed the connection early"
            except urllib.error.HTTPError as error:
                reason = f"the server answers {error.code} {error.reason}"
                if error.code < 500 and error.code not in (408, 429):
                    raise DownloadError(f"{reason} for {self.url}") from error
            except (OSError, http.client.HTTPException, ValueError) as error:  # no route, time-out, TLS, odd redirect
                reason = str(getattr(error, "reason", "") or error) or type(error).__name__
            if self._size() > best:
                fruitless, pause_s, best = 0, wait_s, self._size()
                continue
            fruitless += 1
            if fruitless < attempts:
                time.sleep(pause_s)
                pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
        announced = self._read_notes().get("total")
        expected = f" of {announced}" if announced else ""
        raise DownloadError(f"download of {self.url} stopped at {self._size()}{expected} bytes: {reason}", _GO_ON)

    def forget(self) -> None:
        """Remove the file and its notes."""
        self.part.unlink(missing_ok=True)
        self._notes.unlink(missing_ok=True)

    def _connect(self) -> bool:
        """One request from where the file ends; True if it is whole afterwards."""
        from urllib.error import HTTPError
        from urllib.request import Request

        start, notes = self._size(), self._read_notes()
        if start and notes.get("url") != without_passwords(self.url):
            self.forget()
            start, notes = 0, {}
        request = Request(self.url, headers={"User-Agent": "dynslam-bench", "Accept-Encoding": "identity"})
        if start:
            request.add_header("Range", f"bytes={start}-")
            if validator := notes.get("etag") or notes.get("modified"):
                request.add_header("If-Range", validator)
        try:
            response = connect(request, self.timeout_s)
        except HTTPError as error:
            if error.code != 416 or not start:
                raise
            if (error.headers.get("Content-Range") or "").rpartition("/")[2] == str(start):
                return True
            self.forget()  # longer than the file on the server, or the server does not say: begin again
            return False
        with response:
            if start and response.status == 206:
                if not (response.headers.get("Content-Range") or "").startswith(f"bytes {start}-"):
                    self.forget()  # another range than was asked for
                    return False
            elif start:
                start = 0  # the whole file comes: the server knows no ranges, or the file has changed
            length = response.headers.get("Content-Length")
            total = start + int(length) if length is not None and length.isdigit() else None
            self._write_notes(total, response.headers)
            self._check(total or start)
            free = shutil.disk_usage(self.part.parent).free
            if total is not None and total - start > free:
                raise DownloadError(
                    f"{self.part.parent} has {free / 1e9:.2f} GB free, but {(total - start) / 1e9:.2f} GB are still to "
                    "download",
                    "make room, or name another folder",
                )
            return self._receive(response, start, total)

    def _receive(self, response: Any, start: int, total: int | None) -> bool:
        """Append the body to the file; True if it came to its announced end."""
        from http.client import IncompleteRead

        done = start
        try:
            with self.part.open("r+b" if start else "wb") as file:
                file.seek(start)
                while True:
                    try:
                        block = response.read1(CHUNK)
                    except IncompleteRead as error:
                        file.write(error.partial)
                        return False
                    if not block:
                        return total is None or done == total
                    self._check(done + len(block))
                    file.write(block)
                    done += len(block)
                    self.report(Progress("download", done, total))
        except OSError as error:
            if error.errno not in _DISK_ERRORS:
                raise
            raise DownloadError(
                f"cannot write {self.part} at {done} of {total or 'unknown'} bytes: {error.strerror}",
                f"make room and {_GO_ON}",
            ) from error

    def _check(self, size: int) -> None:
        """Refuse what is too long, and throw away what came of it; end what takes too long, and keep it."""
        if size > self.most_bytes:
            self.forget()
            expected = f"the {self.most_bytes / 1e9:.2f} GB that are expected"
            raise DownloadError(f"{self.url} is longer than {expected}, refused")
        if time.monotonic() > self._end:
            raise DownloadError(
                f"download of {self.url} stopped at {self._size()} bytes: it took longer than {self.deadline_s:g} s",
                _GO_ON,
            )

    def _size(self) -> int:
        return self.part.stat().st_size if self.part.exists() else 0

    def _read_notes(self) -> dict[str, Any]:
        try:
            notes = read_json(self._notes)
        except DynslamError:
            return {}
        return notes if isinstance(notes, dict) else {}

    def _write_notes(self, total: int | None, headers: Any) -> None:
        etag = headers.get("ETag")
        notes = {
            "url": without_passwords(self.url),
            "total": total,
            "etag": None if etag is None or etag.startswith("W/") else etag,  # a weak one cannot validate a range
            "modified": headers.get("Last-Modified"),
        }
        with contextlib.suppress(OSError):  # without notes the next call begins again, which is safe
            self._notes.write_text(json.dumps(notes))


def check_address(url: str, *, checked: bool) -> SplitResult:
    """The parts of an address that may be fetched: https, or http where the content is checked.

    Args:
        url: The address.
        checked: Whether a checksum of the content is known; then plain http will do, and on this machine always.

    Raises:
        DownloadError: Another scheme, no host, characters that no address has, or a password.
    """
    from urllib.parse import urlsplit

    shown = f"cannot download {url[:200]!r}"
    try:
        parts = urlsplit(url)
        host, port = (parts.hostname or "").encode("idna").decode(), parts.port
    except ValueError as error:
        raise DownloadError(f"{shown}: {error}") from error
    if parts.scheme not in ("http", "https"):
        raise DownloadError(shown, "the address has to begin with http:// or https://")
    if not host or port == 0 or not url.isascii() or not url.isprintable() or " " in url:
        raise DownloadError(f"{shown}: it is no web address", "for example https://host/name.tgz")
    if parts.username is not None or parts.password is not None:
        raise DownloadError(f"cannot download from {host}: the address holds a name or password", "leave them out")
    if parts.scheme == "http" and not checked and not _is_loopback(host):
        raise DownloadError(f"{shown}: http without a known checksum could bring anything", "use https")
    return parts


def connect(request: Request, timeout_s: float) -> Any:
    """Open an address as the standard library does, for http and https alone, whatever a server redirects to.

    Raises:
        DownloadError: The server redirects to another scheme.
        OSError: It cannot be reached, or answers with an error.
    """
    import urllib.request

    class Redirect(urllib.request.HTTPRedirectHandler):
        """Follows redirects to https, and from http to http."""

        def redirect_request(self, req: Request, fp: Any, code: int, msg: str, headers: Any, newurl: str) -> Any:
            scheme = newurl.partition(":")[0].lower()
            if scheme not in ("https", req.type):
                raise DownloadError(
                    f"the server redirects {req.full_url} to {newurl[:200]!r}, refused", "name a mirror"
                )
            return super().redirect_request(req, fp, code, msg, headers, newurl)

    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler,
        urllib.request.HTTPHandler,
        urllib.request.HTTPSHandler,
        urllib.request.HTTPDefaultErrorHandler,
        urllib.request.HTTPErrorProcessor,
        Redirect,
    ):
        opener.add_handler(handler())
    return opener.open(request, timeout=timeout_s)


def _is_loopback(host: str) -> bool:
    import ipaddress

    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
