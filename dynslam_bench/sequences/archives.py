"""Extract archives from the network: nothing outside the target, no links, no devices, no bombs."""

from __future__ import annotations

import gzip
import hashlib
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import IO, BinaryIO, Protocol, cast

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
    room = _Room(archive)
    members = _members(archive, room)
    while (member := _next(members, archive)) is not None:
        name, stream = member
        path = target / safe_name(archive, name)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = path.open("xb")
        except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
            raise SequenceError(f"{archive.name} holds one name twice: {error.filename}, refused") from error
        value = hashlib.sha256()
        with file:
            while block := _read(stream, archive):
                file.write(block)
                value.update(block)
        sums[path.relative_to(target).as_posix()] = value.hexdigest()
        if progress is not None:
            progress(Progress("extract", room.taken, None))
    return sums


class _Stream(Protocol):
    def read(self, size: int = -1, /) -> bytes: ...


_Member = tuple[str, _Stream]


class _Room:
    """What an archive may unpack to: bytes of its files, of what lies between and behind them, and entries."""

    def __init__(self, archive: Path) -> None:
        self.archive = archive
        self.limit = archive.stat().st_size * MAX_RATIO + MAX_SLACK
        self.taken = 0
        self.members = 0

    def take(self, count: int) -> None:
        self.taken += count
        if self.taken > self.limit:
            raise SequenceError(f"{self.archive.name} unpacks to more than {self.limit / 1e9:.1f} GB, refused")

    def take_member(self) -> None:
        self.members += 1
        if self.members > MAX_MEMBERS:
            raise SequenceError(f"{self.archive.name} holds more than {MAX_MEMBERS} files, refused")


class _Counted:
    """A stream that takes what is read of it out of the room that there is."""

    def __init__(self, stream: IO[bytes], room: _Room) -> None:
        self.stream = stream
        self.room = room

    def read(self, size: int = -1) -> bytes:
        block = self.stream.read(size)
        self.room.take(len(block))
        return block


def _next(members: Iterator[_Member], archive: Path) -> _Member | None:
    try:
        return next(members, None)
    except _DAMAGE as error:
        raise _damaged(archive, error) from error


def _read(stream: _Stream, archive: Path) -> bytes:
    try:
        return stream.read(CHUNK)
    except _DAMAGE as error:
        raise _damaged(archive, error) from error


# What Python's readers of archives raise over damaged ones; OSError is gzip's, too, and only ever met while reading.
_DAMAGE = (tarfile.TarError, zipfile.BadZipFile, zlib.error, struct.error, OSError, EOFError,
           ValueError, TypeError, LookupError, NotImplementedError, RuntimeError, OverflowError)  # fmt: skip


def _damaged(archive: Path, error: Exception) -> SequenceError:
    size = archive.stat().st_size
    return SequenceError(f"{archive.name} is damaged ({size} bytes): {error}", "fetch it again")


def safe_name(archive: Path, name: str) -> PurePosixPath:
    """The member's name as a relative path.

    Raises:
        SequenceError: It is absolute, leaves the folder, or is empty.
    """
    if not is_inside(name) or ":" in name:
        shown = f"{archive.name} holds {name[:100]!r}"
        raise SequenceError(f"{shown}, which would lie outside the sequence's folder, refused")
    return PurePosixPath(name)


def _members(archive: Path, room: _Room) -> Iterator[_Member]:
    """Names and streams of all regular files."""
    if zipfile.is_zipfile(archive):
        yield from _zip_members(archive, room)
    else:
        yield from _tar_members(archive, room)


def _zip_members(archive: Path, room: _Room) -> Iterator[_Member]:
    with zipfile.ZipFile(archive) as source:
        for member in source.infolist():
            room.take_member()
            kind = (member.external_attr >> 16) & 0o170000
            if kind not in (0, 0o100000, 0o040000):
                raise SequenceError(f"{archive.name} holds {member.filename!r}, no regular file, refused")
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise SequenceError(f"{archive.name} is compressed in a way that is not unpacked here, refused")
            if member.is_dir():
                safe_name(archive, member.filename)
            else:
                with source.open(member) as stream:
                    yield member.filename, _Counted(stream, room)


def _tar_members(archive: Path, room: _Room) -> Iterator[_Member]:
    with archive.open("rb") as raw, _decompressed(raw) as file:
        counted = cast("BinaryIO", _Counted(file, room))
        with tarfile.open(fileobj=counted, mode="r|", tarinfo=_Header) as tar:
            for entry in tar:
                room.take_member()
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


class _Header(tarfile.TarInfo):
    """A header of a tar archive; long names and attributes, which are read as a whole, are bounded."""

    @classmethod
    def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> _Header:
        """See `tarfile.TarInfo`; headers whose content is read at once may not claim to be huge."""
        header = super().frombuf(buf, encoding, errors)
        if header.size < 0 or (not header.isreg() and header.size > MAX_HEADER):
            raise tarfile.ReadError(f"a header claims {header.size} bytes")
        return header


def _decompressed(raw: BinaryIO) -> BinaryIO:
    start = raw.read(2)
    raw.seek(0)
    return cast("BinaryIO", gzip.GzipFile(fileobj=raw)) if start == b"\x1f\x8b" else raw
