"""Extract archives from the network: nothing outside the target, no links, no devices, no bombs."""

from __future__ import annotations

import gzip
import hashlib
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import IO, BinaryIO, cast

from dynslam_bench.core.download import CHUNK, Progress, Report
from dynslam_bench.core.errors import SequenceError

MAX_RATIO = 200
"""Most bytes that a byte of the archive may unpack to; images unpack to about as many as they take."""
MAX_SLACK = 100_000_000


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
            far more data than its size allows.
        OSError: The disk is full.
    """
    limit = archive.stat().st_size * MAX_RATIO + MAX_SLACK
    sums: dict[str, str] = {}
    done = 0
    try:
        for name, stream in _members(archive):
            path = target / safe_name(archive, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            value = hashlib.sha256()
            with stream, path.open("xb") as file:
                while block := stream.read(CHUNK):
                    done += len(block)
                    if done > limit:
                        raise SequenceError(f"{archive.name} unpacks to more than {limit / 1e9:.1f} GB, refused")
                    file.write(block)
                    value.update(block)
            sums[path.relative_to(target).as_posix()] = value.hexdigest()
            if progress is not None:
                progress(Progress("extract", done, None))
    except (tarfile.TarError, zipfile.BadZipFile, gzip.BadGzipFile, zlib.error, EOFError, NotImplementedError) as error:
        size = archive.stat().st_size
        raise SequenceError(f"{archive.name} is damaged ({size} bytes): {error}", "fetch it again") from error
    except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
        raise SequenceError(f"{archive.name} holds one name twice: {error.filename}, refused") from error
    return sums


def safe_name(archive: Path, name: str) -> PurePosixPath:
    """The member's name as a relative path.

    Raises:
        SequenceError: It is absolute, leaves the folder, or is empty.
    """
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name or ":" in name or not path.parts:
        raise SequenceError(f"{archive.name} holds {name!r}, which would lie outside the sequence's folder, refused")
    return path


def _members(archive: Path) -> Iterator[tuple[str, IO[bytes]]]:
    """Names and streams of all regular files."""
    if zipfile.is_zipfile(archive):
        with zipfile.ZipFile(archive) as source:
            for member in source.infolist():
                kind = (member.external_attr >> 16) & 0o170000
                if kind not in (0, 0o100000, 0o040000):
                    raise SequenceError(f"{archive.name} holds {member.filename!r}, no regular file, refused")
                if member.is_dir():
                    safe_name(archive, member.filename)
                else:
                    yield member.filename, source.open(member)
        return
    with archive.open("rb") as raw, _decompressed(raw) as file:
        with tarfile.open(fileobj=file, mode="r|") as tar:
            for entry in tar:
                if entry.isdir():
                    if PurePosixPath(entry.name).parts:  # "." names the archive itself
                        safe_name(archive, entry.name)
                    continue
                stream = tar.extractfile(entry) if entry.isreg() else None
                if stream is None:
                    raise SequenceError(f"{archive.name} holds {entry.name!r}, a link or device, refused")
                yield entry.name, stream
        while file.read(CHUNK):  # tarfile stops before the end of the stream, where gzip keeps its checksum
            pass


def _decompressed(raw: BinaryIO) -> BinaryIO:
    start = raw.read(2)
    raw.seek(0)
    return cast("BinaryIO", gzip.GzipFile(fileobj=raw)) if start == b"\x1f\x8b" else raw
