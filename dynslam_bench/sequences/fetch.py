"""Get public sequences onto this machine, and check those that are there."""

from __future__ import annotations

import errno
import gzip
import hashlib
import os
import shutil
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, NamedTuple, cast

from dynslam_bench.core import (
    DynslamError,
    SequenceError,
    atomic_folder,
    compare_sums,
    did_you_mean,
    find_data_root,
    is_inside,
    read_text,
    temporary_folder,
    translate_errors,
    without_passwords,
    write_atomic,
)
from dynslam_bench.core.download import CHUNK, MOST_BYTES, Progress, Report, download
from dynslam_bench.core.records import Record, schema
from dynslam_bench.sequences.cameras import CameraError
from dynslam_bench.sequences.catalogue import (
    CatalogueEntry,
    catalogue,
    entry_of,
    open_folder,
    open_sequence,
)
from dynslam_bench.sequences.readers.layouts import layout_of

RECEIPT = "fetched.json"
"""File in the sequence's folder that tells what was fetched, as a `Receipt`."""
MANIFEST = "manifest.sha256"
"""Checksums of its files, in the format of ``sha256sum``."""


class Receipt(Record):
    """Record of a fetched archive, stored inside the sequence's folder.

    Attributes:
        schema_version: Version of this record.
        id: The sequence.
        url: Where it came from.
        sha256: Checksum of the archive.
        size_bytes: Size of the archive.
        checked: Whether the catalogue knew the checksum.
        files: Number of files extracted; their checksums are in ``manifest.sha256``.
    """

    schema_version: int = schema(1)
    id: str
    url: str
    sha256: str
    size_bytes: int
    checked: bool
    files: int


@dataclass(frozen=True)
class Verification:
    """The outcome of `verify`.

    Attributes:
        id: The sequence.
        folder: Folder in which it lies.
        frames: Frames that were decoded.
        faults: One line a fault; empty if all is sound.
        manifest: Whether every file was compared with the checksum taken when it was fetched.
        dropped: What was not used on opening; empty if the sequence cannot be opened.
    """

    id: str
    folder: Path
    frames: int
    faults: tuple[str, ...]
    manifest: bool
    dropped: str

    @property
    def ok(self) -> bool:
        """Whether no fault was found."""
        return not self.faults


class Download(NamedTuple):
    """An archive that was downloaded: its address, the file and its checksum."""

    address: str
    archive: Path
    sha256: str


def status(name: str, *, data_root: str | Path | None = None) -> Path | None:
    """Folder of a public sequence, None if it is not on this machine.

    Raises:
        SequenceError: Unknown id.
    """
    return _known(name).find(find_data_root(data_root))


def fetch(
    name: str,
    *,
    data_root: str | Path | None = None,
    progress: Report = lambda state: None,
    checksum: bool = True,
    keep_archive: bool = False,
    url: str | None = None,
    attempts: int = 6,
    wait_s: float = 1.0,
    timeout_s: float = 30.0,
) -> Path:
    """Download and extract a public sequence; one that is here already is left alone.

    After any failure no partial sequence is left, and the next call resumes where this one stopped.

    Args:
        name: Id or published folder name.
        data_root: Folder of the sequences.
        progress: Called with the stage and the bytes done.
        checksum: False to accept an archive whose checksum differs from the catalogue's or, where
            that knows none, from that of the archive which this address gave before.
        keep_archive: True to keep the archive beside the sequence.
        url: A mirror, in place of the catalogue's address.
        attempts: Connections in a row that may fail without bringing a byte.
        wait_s: Pause before the second attempt.
        timeout_s: How long a connection may be silent.

    Returns:
        The sequence's folder.

    Raises:
        SequenceError: Unknown id, one that has to be got by hand, or a faulty archive.
        DownloadError: The archive cannot be downloaded.
    """
    # what is here already is left alone
    entry = _known(name)
    root = find_data_root(data_root)
    folder = entry.find(root)
    if folder is not None:
        return folder
    if entry.by_hand:
        raise SequenceError(
            f"'{entry.id}' cannot be fetched by this program: {entry.by_hand}", entry.how_to_get()
        )

    # download every archive; the catalogue knows the first one's checksum only.
    parts: list[Download] = []
    for address in (url or entry.url, *entry.more_urls):
        archive = root / ".downloads" / _archive_name(address, entry)
        sha256 = download(
            address,
            archive,
            sha256=entry.sha256 if checksum and not parts else None,
            most_bytes=(entry.size_bytes if checksum else None) or MOST_BYTES,
            attempts=attempts,
            wait_s=wait_s,
            timeout_s=timeout_s,
            progress=progress,
        )
        parts.append(Download(address, archive, sha256))

    # the others have to be what their address gave before.
    unstated = parts if entry.sha256 is None else parts[1:]
    if checksum:
        for part in unstated:
            _compare_checksum(root, part)

    # unpack them into the sequence's folder
    place = entry.folders(root)[0]
    _install(entry, place, parts, checksum and entry.sha256 is not None, progress)

    # checksums are kept only of archives whose sequence could be opened.
    for part in unstated:
        line = f"{part.sha256}  {without_passwords(part.address)}\n"
        write_atomic(_checksum_file(root, part), line)
    if not keep_archive:
        for part in parts:
            part.archive.unlink(missing_ok=True)
    return place


def _archive_name(address: str, entry: CatalogueEntry) -> str:
    """The last part of an address where it can be a file's name, else a name by the sequence's folder."""
    last = address.partition("?")[0].rpartition("/")[2]
    usable = is_inside(last) and not last.startswith(".") and len(last) < 200
    return last if usable else f"{entry.folder}.archive"


def _install(
    entry: CatalogueEntry, place: Path, parts: list[Download], checked: bool, progress: Report
) -> None:
    """Let the sequence appear if it can be opened; a faulty archive is deleted, so that the next call fetches it."""
    first = parts[0].archive
    size = first.stat().st_size
    fault = f"cannot extract {first.name} ({size / 1e9:.2f} GB) into {place.parent}"
    hint = "make room or check the permissions and run the same command again, the archive is kept"
    with translate_errors(SequenceError, fault, hint):
        try:
            # the files, a receipt and their checksums; the folder appears if it opens as a sequence
            with atomic_folder(place) as work:
                files = _unpack_sequence(entry, parts, work, progress)
                receipt = Receipt(
                    id=entry.id,
                    url=parts[0].address,
                    sha256=parts[0].sha256,
                    size_bytes=size,
                    checked=checked,
                    files=len(files),
                )
                write_atomic(work / RECEIPT, receipt.to_json())
                lines = [f"{value}  {name}\n" for name, value in sorted(files.items())]
                write_atomic(work / MANIFEST, "".join(lines))
                open_folder(work, entry=entry)
        except SequenceError:
            for part in parts:
                part.archive.unlink(missing_ok=True)
            raise


def _unpack_sequence(
    entry: CatalogueEntry, parts: list[Download], work: Path, progress: Report
) -> dict[str, str]:
    """Unpack the folder of the archives that is the sequence into `work`; SHA-256 of each file by its path in it."""
    # all archives over one another, of which one folder is the sequence
    unpacked = work / ".unpacked"
    sums = _unpack(parts, unpacked, progress)
    top = _top(unpacked, entry, parts[0].archive)

    # its files move up, and their names in the checksums likewise
    inner = "" if top == unpacked else f"{top.relative_to(unpacked).as_posix()}/"
    shutil.copytree(top, work, copy_function=os.replace, dirs_exist_ok=True)
    shutil.rmtree(unpacked)
    return {
        name.removeprefix(inner): value for name, value in sums.items() if name.startswith(inner)
    }


def _unpack(parts: list[Download], target: Path, progress: Report) -> dict[str, str]:
    """Unpack archives over one another; SHA-256 of each file by its path. What two of them hold has to be the same."""
    sums: dict[str, str] = {}
    for part in parts:
        with temporary_folder(target) as beside:
            for name, value in extract(part.archive, beside, progress).items():
                if sums.setdefault(name, value) != value:
                    raise SequenceError(
                        f"{part.archive.name} holds another {name} than the first archive, refused"
                    )
            shutil.copytree(beside, target, copy_function=os.replace, dirs_exist_ok=True)
    return sums


def verify(
    name: str,
    *,
    data_root: str | Path | None = None,
    camera: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Verification:
    """Decode every frame, and compare every file with the checksum taken when it was fetched.

    Args:
        name: Id, published folder name or path of a sequence that is here.
        data_root: Folder of the sequences.
        camera: Camera of a folder that does not say its own, as in `open_sequence`.
        progress: Called with frames done and frames in all.

    Raises:
        SequenceError: Unknown id, or the sequence is not here, or it needs a `camera` to be named.
    """
    # where it lies
    entry = entry_of(name)
    folder = Path(name).expanduser() if entry is None else status(name, data_root=data_root)
    if folder is None or not folder.is_dir():
        # says what is missing
        open_sequence(name, data_root=data_root)
        raise SequenceError(
            f"'{name}' is not a recorded sequence", "rendered sequences need no verification"
        )
    try:
        sequence = open_folder(folder, entry=entry, camera=camera)
    except CameraError:
        raise
    except DynslamError as error:
        return Verification(name, folder, 0, (str(error),), False, "")

    # decode every frame
    faults = []
    for index in range(len(sequence)):
        try:
            sequence[index]
        except SequenceError as error:
            faults.append(f"frame {index}: {error}")
        progress(index + 1, len(sequence))

    # compare every file with its checksum
    manifest = folder / MANIFEST
    if manifest.is_file():
        try:
            faults += compare_sums(folder, manifest, SequenceError)
        except SequenceError as error:
            faults.append(str(error))
    return Verification(
        id=sequence.id,
        folder=folder,
        frames=len(sequence),
        faults=tuple(faults),
        manifest=manifest.is_file(),
        dropped=getattr(sequence, "dropped", ""),
    )


def _top(work: Path, entry: CatalogueEntry, archive: Path) -> Path:
    """The folder inside the extracted archive that is the sequence."""
    layout = layout_of(entry.layout)
    folders = sorted(path for path in work.iterdir() if path.is_dir())
    for candidate in (work / entry.folder, work, *folders):
        if layout.fits(candidate):
            return candidate
    hint = f"it is not a sequence in the layout {layout.name}"
    raise SequenceError(f"{archive.name} holds no {' and '.join(layout.marks)}", hint)


def _known(name: str) -> CatalogueEntry:
    """The catalogue's entry of a public sequence; says what is wrong where there is none."""
    entry = entry_of(name)
    if entry is None:
        if name.startswith("synthetic/"):
            raise SequenceError(
                f"'{name}' needs no fetching", "rendered sequences appear when they are first read"
            )
        raise SequenceError(f"unknown sequence '{name}'", did_you_mean(name, catalogue()))
    return entry


def _compare_checksum(root: Path, part: Download) -> None:
    """Refuse and delete an archive that is not what its address gave before, where no publisher states a checksum."""
    path = _checksum_file(root, part)
    if not path.is_file():
        return
    first = (read_text(path, kind=SequenceError).split() or ["none"])[0]
    if first != part.sha256:
        # the next call fetches it again
        part.archive.unlink(missing_ok=True)
        raise SequenceError(
            f"{without_passwords(part.address)} has the checksum {part.sha256}, but gave {first} before",
            f"the file has changed; --no-checksum takes it all the same, and {path} says what came first",
        )


def _checksum_file(root: Path, part: Download) -> Path:
    """One file an address, so that several processes may fetch at a time."""
    address = hashlib.sha256(without_passwords(part.address).encode()).hexdigest()
    return root / ".downloads" / f"{address[:16]}.sha256"


# Extraction of archives: nothing outside the target, no links, no devices, no bombs.

MAX_RATIO = 200
"""Most bytes that a byte of the archive may unpack to; images unpack to about as many as they take."""
MAX_SLACK = 100_000_000
"""Bytes that may be unpacked beyond `MAX_RATIO`."""
MAX_MEMBERS = 200_000
"""Most files and folders of an archive; the largest public sequence has fewer than 20,000."""
MAX_HEADER = 1 << 20
"""Most bytes of one name or one set of attributes in a tar archive."""
DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
"""Errors of a disk, or of a user's share of it, that is full."""

# what Python's readers of archives raise over damaged ones; OSError is gzip's, too.
_DAMAGE = (
    tarfile.TarError,
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    OSError,
    EOFError,
    ValueError,
    TypeError,
    LookupError,
    NotImplementedError,
    RuntimeError,
    OverflowError,
)


def extract(archive: Path, target: Path, progress: Report = lambda state: None) -> dict[str, str]:
    """Extract all regular files of a ``.tgz``, ``.tar`` or ``.zip`` into a folder.

    Args:
        archive: The archive.
        target: An existing, empty folder that the caller throws away if this fails.
        progress: Called with the bytes extracted.

    Returns:
        SHA-256 of each file by its path inside the target.

    Raises:
        SequenceError: No archive, damaged, or it holds what it must not: names outside the target,
            links, devices, too many files, far more data than its size allows.
        OSError: The disk is full, or the target cannot be written.
    """
    sums = dict[str, str]()
    done = 0
    try:
        members = _zip_members if zipfile.is_zipfile(archive) else _tar_members
        for name, stream in members(archive):
            # block by block, with the checksum
            path = target / safe_name(archive, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            checksum = hashlib.sha256()
            with path.open("xb") as file:
                while block := stream.read(CHUNK):
                    file.write(block)
                    checksum.update(block)
                    done += len(block)
            sums[path.relative_to(target).as_posix()] = checksum.hexdigest()
            progress(Progress("extract", done, None))
    except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
        raise SequenceError(
            f"{archive.name} holds one name twice: {error.filename}, refused"
        ) from error
    except _DAMAGE as error:
        # faults of the target are not the archive's.
        if isinstance(error, OSError) and (error.filename is not None or error.errno in DISK_FULL):
            raise
        size = archive.stat().st_size
        raise SequenceError(
            f"{archive.name} is damaged ({size} bytes): {error}", "fetch it again"
        ) from error
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
    """Refuse an archive that unpacks to more bytes, or holds more members, than is allowed."""
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
            # Unix's type of the file: not stated, a regular file or a folder.
            if (entry.external_attr >> 16) & 0o170000 not in (0, 0o100000, 0o040000):
                raise SequenceError(
                    f"{archive.name} holds {entry.filename!r}, no regular file, refused"
                )
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise SequenceError(
                    f"{archive.name} is compressed in a way that is not unpacked here, refused"
                )
            if entry.is_dir():
                safe_name(archive, entry.filename)
            else:
                with source.open(entry) as stream:
                    yield entry.filename, stream


def _tar_members(archive: Path) -> Iterator[tuple[str, IO[bytes]]]:
    """Names and streams of all regular files, compressed or not, in the order of the archive."""
    with archive.open("rb") as start:
        compressed = start.read(2) == b"\x1f\x8b"
    with gzip.open(archive) if compressed else archive.open("rb") as file:
        counted = _Counted(archive, cast("IO[bytes]", file))
        with tarfile.open(fileobj=cast("IO[bytes]", counted), mode="r|", tarinfo=_Header) as tar:
            for number, entry in enumerate(tar, 1):
                _check(archive, 0, number)
                # it would keep the header of every file
                tar.members = []  # type: ignore[attr-defined]
                if entry.isdir():
                    # "." names the archive itself
                    if PurePosixPath(entry.name).parts:
                        safe_name(archive, entry.name)
                    continue
                stream = tar.extractfile(entry) if entry.isreg() and not entry.issparse() else None
                if stream is None:
                    raise SequenceError(
                        f"{archive.name} holds {entry.name!r}, a link or device, refused",
                        "of results, pack the folders runs and sequences alone",
                    )
                yield entry.name, stream
        # tarfile stops before the end of the stream, where gzip keeps its checksum
        while counted.read(CHUNK):
            pass


class _Counted:
    """A stream that refuses to give more bytes than the archive may unpack to."""

    def __init__(self, archive: Path, stream: IO[bytes]) -> None:
        self.archive = archive
        self.stream = stream
        self.total = 0

    def read(self, size: int = -1) -> bytes:
        """See `io.BufferedIOBase.read`."""
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
