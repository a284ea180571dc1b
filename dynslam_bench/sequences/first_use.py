"""Checksums that no publisher states: taken when an archive first came to a data root, compared ever after."""

from __future__ import annotations

import hashlib
from pathlib import Path

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.core.files import write_atomic
from dynslam_bench.core.passwords import without_passwords
from dynslam_bench.core.reading import read_text


def compare(root: Path, address: str, archive: Path, sha256: str) -> None:
    """Refuse an archive that is not what its address gave before; it is deleted then.

    Args:
        root: The data root.
        address: Where the archive came from.
        archive: The archive.
        sha256: Its checksum.

    Raises:
        SequenceError: It is another one.
    """
    path = _file(root, address)
    if not path.is_file():
        return
    first = read_text(path, kind=SequenceError).split()[0:1]
    if first != [sha256]:
        archive.unlink(missing_ok=True)  # the next call fetches it anew
        raise SequenceError(
            f"{without_passwords(address)} has the checksum {sha256}, but gave {first[0] if first else 'none'} before",
            f"somebody has changed it; --no-checksum takes it all the same, and {path} says what came first",
        )


def remember(root: Path, address: str, sha256: str) -> None:
    """Keep the checksum of an archive whose sequence could be opened.

    Raises:
        DynslamError: It cannot be written.
    """
    write_atomic(_file(root, address), f"{sha256}  {without_passwords(address)}\n")


def _file(root: Path, address: str) -> Path:
    """One file an address, so that several processes may fetch at a time."""
    return root / ".downloads" / f"{hashlib.sha256(without_passwords(address).encode()).hexdigest()[:16]}.sha256"
