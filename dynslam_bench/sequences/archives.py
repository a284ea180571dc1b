"""Extract archives from the network: nothing outside the target, no links, no devices, no bombs."""

from __future__ import annotations

import errno
import gzip
import hashlib
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import IO, cast

from dynslam_bench.core.download import CHUNK, Progress, Report
from dynslam_bench.core.errors import SequenceError
from dynslam_bench.core.sanitise import is_inside

MAX_RATIO = 200
"""Most bytes that a byte of the archive may unpack to; images unpack to about as many as they take."""
MAX_SLACK = 100_000_000
MAX_MEMBERS = 200_000
"""Most files and folders of an archive; the largest public sequence has fewer than 20,000."""
MAX_HEADER = 1 << 20
"""Most bytes of one name or one set of attributes in a tar archive."""
DISK_FULL = (errno.ENOSPC, errno.EDQUOT)

# What Python's readers of archives raise over damaged ones; OSError is gzip's, too.
_DAMAGE = (tarfile.TarError, zipfile.BadZipFile, zlib.error, struct.error, OSError, EOFError,
           ValueError, TypeError, LookupError, NotImplementedError, RuntimeError, OverflowError)  # fmt: skip


def extract(archive: Path, target: Path, progress: Report | None = None) -> dict[str, str]:
    """Extract all regular files of a ``.tgz``, ``.tar`` or ``.zip`` into a folder.

    Args:
        archive: The archive.
        target: An existing, empty folder that the caller throws away if this fails.
        progress: Called with the bytes extracted.

    Returns:
        SHA-256 of each file by its path inside the target.

    Raises:
        SequenceError: No archive, damaged, or it holds what it must not: names outside the target, links, devices,
            too many files, far more data than its size allows.
        OSError: The disk is full, or the target cannot be written.
    """
    sums: dict[str, str] = {}
    done = 0
    try:
        for name, stream in (_zip_members if zipfile.is_zipfile(archive) else _tar_members)(archive):
            path = target / safe_name(archive, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            checksum = hashlib.sha256()
            with path.open("xb") as file:
                while block := stream.read(CHUNK):
                    file.write(block)
                    checksum.update(block)
                    done += len(block)
            sums[path.relative_to(target).as_posix()] = checksum.hexdigest()
            if progress is not None:
                progress(Progress("extract", done, None))
    except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
        raise SequenceError(f"{archive.name} holds one name twice: {error.filename}, refused") from error
    except _DAMAGE as error:
        if isinstance(error, OSError) and (error.filename is not None or error.errno in DISK_FULL):
            raise  # of the target, not of the archive
        size = archive.stat().st_size
        raise SequenceError(f"{archive.name} is damaged ({size} bytes): {error}", "fetch it again") from error
    return sums


def safe_name(archive: Path, name: str) -> PurePosixPath:
    """The member's name as a relative path.

    Raises:
        SequenceError: It is absolute, leaves the folder, or is empty.
    """
    if not is_inside(name) or ":" in name:
        raise SequenceError(
            f"{archive.name} holds {name[:100]!r}, which would lie outside the sequence's folder, refused"
        )
    return PurePosixPath(name)


def _check(archive: Path, size: int, members: int = 0) -> None:
    limit = archive.stat().st_size * MAX_RATIO + MAX_SLACK
    if size > limit:
        raise SequenceError(f"{archive.name} unpacks to more than {limit / 1e9:.1f} GB, refused")
    if members > MAX_MEMBERS:
        raise SequenceError(f"{archive.name} holds more than {MAX_MEMBERS} files, refused")


def _zip_members(archive: Path) -> Iterator[tuple[str, IO[bytes]]]:
    """Names and streams of all regular files; zipfile never reads more of a file than its header states."""
    with zipfile.ZipFile(archive) as source:
        entries = source.infolist()
        _check(archive, sum(entry.file_size for entry in entries), len(entries))
        for entry in entries:
            if (entry.external_attr >> 16) & 0o170000 not in (0, 0o100000, 0o040000):
                raise SequenceError(f"{archive.name} holds {entry.filename!r}, no regular file, refused")
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise SequenceError(f"{archive.name} is compressed in a way that is not unpacked here, refused")
            if entry.is_dir():
                safe_name(archive, entry.filename)
            else:
                with source.open(entry) as stream:
                    yield entry.filename, stream


def _tar_members(archive: Path) -> Iterator[tuple[str, IO[bytes]]]:
    with archive.open("rb") as start:
        compressed = start.read(2) == b"\x1f\x8b"
    with gzip.open(archive) if compressed else archive.open("rb") as file:
        counted = _Counted(archive, cast("IO[bytes]", file))
        with tarfile.open(fileobj=cast("IO[bytes]", counted), mode="r|", tarinfo=_Header) as tar:
            for number, entry in enumerate(tar, 1):
                _check(archive, 0, number)
                tar.members = []  # type: ignore[attr-defined]  # it would keep the header of every file
                if entry.isdir():
                    if PurePosixPath(entry.name).parts:  # "." names the archive itself
                        safe_name(archive, entry.name)
                    continue
                stream = tar.extractfile(entry) if entry.isreg() and not entry.issparse() else None
                if stream is None:
                    raise SequenceError(f"{archive.name} holds {entry.name!r}, a link or device, refused")
                yield entry.name, stream
        while counted.read(CHUNK):  # tarfile stops before the end of the stream, where gzip keeps its checksum
            pass


class _Counted:
    """A stream that refuses to give more bytes than the archive may unpack to."""

    def __init__(self, archive: Path, stream: IO[bytes]) -> None:
        self.archive, self.stream, self.total = archive, stream, 0

    def read(self, size: int = -1) -> bytes:
        block = self.stream.read(size)
        self.total += len(block)
        _check(self.archive, self.total)
        return block


class _Header(tarfile.TarInfo):
    """A header of a tar archive; long names and attributes, which are read as a whole, are bounded."""

    @classmethod
    def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> _Header:
        """See `tarfile.TarInfo`; headers whose content is read at once may not claim to be huge."""
        header = super().frombuf(buf, encoding, errors)
        if header.size < 0 or (not header.isreg() and header.size > MAX_HEADER):
            raise tarfile.ReadError(f"a header claims {header.size} bytes")
        return header
