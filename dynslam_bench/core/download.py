"""Resumable download of one file over HTTP, bounded in size."""

import contextlib
import errno
import json
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from typing import Any, Literal
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import HTTPRedirectHandler, Request, build_opener

from dynslam_bench.core.errors import DownloadError, DynslamError, translate_errors
from dynslam_bench.core.files import try_lock
from dynslam_bench.core.reading import file_sha256, read_json
from dynslam_bench.core.sanitise import without_passwords

CHUNK = 1 << 18
"""Bytes that are read and written at a time."""
MOST_BYTES = 32 * 2**30
"""A longer file is refused where nothing else is said."""
_LONGEST_PAUSE_S = 30.0
"""Bound of the pause between two attempts, which doubles each time."""
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS, errno.EIO)
"""Faults of this machine's disk, which another attempt does not cure."""
_LOOPBACK = ("localhost", "127.0.0.1", "::1")
"""Names of this machine: plain http to it does not leave it."""
_GO_ON = "run the same command again, it goes on from there"


@dataclass(frozen=True)
class Progress:
    """Progress of a fetch.

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
"""The display given to `show_downloads`, in a list of one; empty where nothing is shown."""


def show_downloads(display: Display) -> None:
    """Set how this process shows every download that is called without `progress`; the command line does so."""
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
) -> str:
    """Download a file; what an earlier call got is kept, and the download goes on where that stopped.

    The bytes gather in ``<target>.part``; `target` appears only when it is whole and its checksum
    fits.

    Args:
        url: An ``https`` address, or an ``http`` one where the checksum is known.
        target: The file to write.
        sha256: Expected checksum, or its first digits; None if it is not known.
        progress: Called with the bytes done; None leaves that to what `show_downloads` was given.
        attempts: Connections in a row that may fail without bringing a single byte.
        wait_s: Pause before the second attempt, doubled before each further one.
        timeout_s: How long a connection may be silent.
        most_bytes: A longer file is refused.

    Returns:
        SHA-256 of the file.

    Raises:
        DownloadError: The address is none; the server cannot be reached, refuses, redirects to
            something else than the web, or announces another length than it sends; the file is too
            long; the disk is full; the checksum is wrong (then the bytes are thrown away), or
            another process downloads the same file.
        DynslamError: The folder cannot be written.
    """
    check_address(url, checked=sha256 is not None)
    part = target.with_name(target.name + ".part")
    with translate_errors(DownloadError, f"cannot write {target}", "name another folder"):
        target.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as stack:
            if not stack.enter_context(try_lock(part.with_name(part.name + ".lock"))):
                raise DownloadError(
                    f"another process is downloading {url}",
                    "wait for it, then run the same command again",
                )
            report = progress
            if report is None and _display:
                report = stack.enter_context(_display[0](target.name))
            if report is None:
                report = _report_nothing

            # what is missing of the file
            partial = _Partial(url, part, report, timeout_s, most_bytes)
            if not target.is_file():
                partial.complete(attempts, wait_s)

            # a wrong file is removed, so that the next call begins again
            file = target if target.is_file() else part
            checksum = _checksum(file, report)
            if sha256 is not None and not checksum.startswith(sha256):
                size = file.stat().st_size
                file.unlink()
                partial.forget()
                raise DownloadError(
                    f"{url} has the checksum {checksum} ({size} bytes), expected {sha256}",
                    "the bytes were thrown away; fetch again, or skip the checksum if the publisher changed the file",
                )
            file.replace(target)
            partial.forget()  # also what a process left that was killed between these two lines
            return checksum


def _report_nothing(progress: Progress) -> None:
    """Shows no progress."""


def _checksum(file: Path, report: Report) -> str:
    """SHA-256 of a file, whose progress is reported."""
    return file_sha256(file, lambda done, total: report(Progress("check", done, total)))


@dataclass(frozen=True)
class _Partial:
    """A partial download with its notes: where it came from, and what the server calls that version."""

    url: str
    part: Path
    report: Report
    timeout_s: float
    most_bytes: int

    def complete(self, attempts: int, wait_s: float) -> None:
        """Connect until the file is whole.

        Args:
            attempts: Connections in a row that may fail without bringing a single byte.
            wait_s: Pause before the second attempt, doubled before each further one.

        Raises:
            DownloadError: The attempts are used up, or the server refuses.
        """
        fruitless = 0
        best = self._size()
        total = None
        reason = ""
        while fruitless < attempts:
            try:
                with self._connect() as response:
                    total = self._begin_or_continue(response)
                    if self._receive(response, total):
                        return
                reason = "the server closed the connection early"
            except HTTPError as error:
                # 416: there is nothing after what was got before
                if error.code == 416 and self._size():
                    length = error.headers.get("Content-Range", "").rpartition("/")[2]
                    if length == str(self._size()):
                        return
                    # longer than the file on the server, or the server does not say: begin again
                    self.forget()
                reason = f"the server answers {error.code} {error.reason}"
                # time-out, range and too many requests may pass; so may faults of the server (5xx)
                if error.code < 500 and error.code not in (408, 416, 429):
                    raise DownloadError(f"{reason} for {self.url}") from error
            # no route, time-out, TLS, odd redirect
            except (OSError, HTTPException, ValueError) as error:
                reason = str(getattr(error, "reason", "") or error) or type(error).__name__
            # a connection that brought bytes is followed by the next one at once
            if self._size() > best:
                fruitless = 0
            else:
                fruitless += 1
            best = max(best, self._size())
            if 0 < fruitless < attempts:
                pause_s = 2 ** (fruitless - 1) * wait_s
                time.sleep(min(pause_s, _LONGEST_PAUSE_S))
        expected = f" of {total}" if total else ""
        raise DownloadError(
            f"download of {self.url} stopped at {self._size()}{expected} bytes: {reason}", _GO_ON
        )

    def forget(self) -> None:
        """Remove the file and its notes."""
        self.part.unlink(missing_ok=True)
        self._notes.unlink(missing_ok=True)

    def _connect(self) -> Any:
        """Ask for what is missing, if the server still has the version that the file was begun with."""
        try:
            notes = dict(read_json(self._notes))
        except (DynslamError, TypeError, ValueError):
            notes = {}
        if notes.get("url") != without_passwords(self.url):
            self.forget()
        request = Request(
            self.url, headers={"User-Agent": "dynslam-bench", "Accept-Encoding": "identity"}
        )
        if self._size():
            request.add_header("Range", f"bytes={self._size()}-")
            if notes.get("version"):
                request.add_header("If-Range", notes["version"])
        return build_opener(_Redirect).open(request, timeout=self.timeout_s)

    def _begin_or_continue(self, response: Any) -> int | None:
        """Prepare the partial file for an answer's bytes.

        The file is begun again where the answer is not its rest, and the server's name for this
        version is noted.

        Returns:
            The length of the whole file in bytes; None where the server does not say.

        Raises:
            DownloadError: The file is too long, or does not fit on the disk.
            ValueError: The answer is another range than was asked for.
        """
        headers = response.headers
        is_rest = headers.get("Content-Range", "").startswith(f"bytes {self._size()}-")
        if response.status != 206 or not is_rest:
            self.forget()  # the server knows no ranges, or the file has changed
        if response.status == 206 and not is_rest:
            raise ValueError("the server sends another range than was asked for")
        # a weak ETag (W/...) validates no range
        etag = headers.get("ETag") or "W/"
        version = headers.get("Last-Modified") if etag.startswith("W/") else etag
        # without notes the next call begins again, which is safe
        with contextlib.suppress(OSError):
            self._notes.write_text(
                json.dumps({"url": without_passwords(self.url), "version": version})
            )
        if not headers.get("Content-Length", "").isdigit():
            return None
        missing = int(headers["Content-Length"])
        free = shutil.disk_usage(self.part.parent).free
        self._check_length(self._size() + missing)
        if missing > free:
            raise DownloadError(
                f"{self.part.parent} has {free / 1e9:.2f} GB free, but {missing / 1e9:.2f} GB are still to download",
                "make room, or name another folder",
            )
        return self._size() + missing

    def _receive(self, response: Any, total: int | None) -> bool:
        """Append the body to the file; True if it came to its announced end."""
        done = self._size()
        try:
            with self.part.open("ab") as file:
                while block := response.read1(CHUNK):
                    done += len(block)
                    self._check_length(done)
                    file.write(block)
                    self.report(Progress("download", done, total))
            return total is None or done == total
        except OSError as error:
            if error.errno not in _DISK_ERRORS:
                raise
            raise DownloadError(
                f"cannot write {self.part} at {done} of {total or 'unknown'} bytes: {error.strerror}",
                f"make room and {_GO_ON}",
            ) from error

    def _check_length(self, size: int) -> None:
        """Refuse a file that is too long, and throw away what came of it.

        Raises:
            DownloadError: It has more than `most_bytes`.
        """
        if size > self.most_bytes:
            self.forget()
            expected = f"the {self.most_bytes / 1e9:.2f} GB that are expected"
            raise DownloadError(f"{self.url} is longer than {expected}, refused")

    def _size(self) -> int:
        """Bytes of the partial file."""
        return self.part.stat().st_size if self.part.exists() else 0

    @property
    def _notes(self) -> Path:
        """The file beside it with the address, and the server's name for the version."""
        return self.part.with_name(self.part.name + ".json")


def check_address(url: str, *, checked: bool) -> None:
    """Check that an address may be fetched: https, or http where the content is checked.

    Args:
        url: The address.
        checked: Whether a checksum of the content is known; then plain http will do, and on this machine always.

    Raises:
        DownloadError: Another scheme, no host, characters that no address has, or a password.
    """
    shown = f"cannot download {url[:200]!r}"
    with translate_errors(DownloadError, f"{shown}", of=ValueError):
        parts = urlsplit(url)
        host = (parts.hostname or "").encode("idna").decode()
        port = parts.port
    if parts.scheme not in ("http", "https"):
        raise DownloadError(shown, "the address has to begin with http:// or https://")
    if not host or port == 0 or not url.isascii() or not url.isprintable() or " " in url:
        raise DownloadError(f"{shown}: it is no web address", "for example https://host/name.tgz")
    if parts.username is not None or parts.password is not None:
        raise DownloadError(
            f"cannot download from {host}: the address holds a name or password", "leave them out"
        )
    if parts.scheme == "http" and not checked and host not in _LOOPBACK:
        raise DownloadError(
            f"{shown}: http without a known checksum could bring anything", "use https"
        )


class _Redirect(HTTPRedirectHandler):
    """Follows redirects to https, and from http to http, and to no other scheme."""

    def redirect_request(
        self, req: Request, fp: Any, code: int, msg: str, headers: Any, newurl: str
    ) -> Any:
        if newurl.partition(":")[0].lower() not in ("https", req.type):
            raise DownloadError(
                f"the server redirects {req.full_url} to {newurl[:200]!r}, refused", "name a mirror"
            )
        return super().redirect_request(req, fp, code, msg, headers, newurl)
