"""The DBoW2 text vocabulary of ORB-SLAM3: found, decompressed into the cache, checked before it is loaded."""

from __future__ import annotations

import hashlib
import lzma
import os
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from dynslam_bench.core.errors import TrackerError
from dynslam_bench.core.files import write_atomic
from dynslam_bench.core.folders import vocabularies_folder
from dynslam_bench.core.reading import MEGABYTE, read_bytes

from .settings import OrbSlam3Settings

ENVIRONMENT_VARIABLE = "DYNSLAM_BENCH_ORB_VOCABULARY"
HINT = (
    f"name ORBvoc.txt of the ORB-SLAM3 repository or another ORB vocabulary in DBoW2's text format, .txt or .txt.xz, "
    f"with --set vocabulary=FILE or ${ENVIRONMENT_VARIABLE}"
)
MOST_BYTES = 512 * MEGABYTE
"""The vocabulary of ORB-SLAM3 has 145 MB."""
MOST_MEMORY = 256 * MEGABYTE
"""Most memory that its decompression may take."""
TOKENS = 35  # parent, whether it is a leaf, 32 bytes of the descriptor, weight


def files(settings: OrbSlam3Settings) -> list[Path]:
    """The vocabulary, whose content decides what ORB-SLAM3 finds again.

    Raises:
        TrackerError: See `find_vocabulary`.
    """
    return [find_vocabulary(settings.vocabulary)]


def find_vocabulary(setting: str) -> Path:
    """The vocabulary as a checked ``.txt`` file.

    Args:
        setting: Path of a ``.txt`` or ``.txt.xz`` file; empty for the environment variable's.

    Raises:
        TrackerError: None is named, it is missing, cannot be read, or is no complete vocabulary.
    """
    named = setting.strip() or os.environ.get(ENVIRONMENT_VARIABLE, "").strip()
    if not named:
        raise TrackerError("orbslam3 needs an ORB vocabulary and none is named", HINT)
    path = Path(named).expanduser().absolute()
    if not path.is_file():
        raise TrackerError(f"orbslam3: no vocabulary file {path}", HINT)
    try:
        stamp = path.stat()
        return _prepared(path, stamp.st_size, stamp.st_mtime_ns)
    except OSError as error:
        raise TrackerError(f"orbslam3: cannot read the vocabulary {path}: {error.strerror}", HINT) from error


@lru_cache(maxsize=8)
def _prepared(path: Path, size: int, modified_ns: int) -> Path:
    """Decompress if need be, check; once in a process as long as the file's size and time stay."""
    if path.suffix != ".xz":
        _check(read_bytes(path, limit=MOST_BYTES, kind=TrackerError), path)
        return path
    packed = read_bytes(path, limit=MOST_BYTES, kind=TrackerError)
    target = vocabularies_folder() / f"{hashlib.sha256(packed).hexdigest()[:16]}.txt"
    if target.is_file():
        _check(read_bytes(target, limit=MOST_BYTES, kind=TrackerError), target)
        return target
    try:
        text = _unpack(packed)
    except (lzma.LZMAError, EOFError, ValueError) as error:
        raise TrackerError(
            f"orbslam3: the vocabulary {path} ({size} bytes) is no intact .xz file: {error}", HINT
        ) from None
    _check(text, path)
    write_atomic(target, text)
    return target


def _unpack(packed: bytes) -> bytes:
    """The content of an .xz file; a small file that claims or holds far more is a ValueError."""
    reader = lzma.LZMADecompressor(format=lzma.FORMAT_XZ, memlimit=MOST_MEMORY)
    text = reader.decompress(packed, max_length=MOST_BYTES)
    if not reader.eof:
        raise ValueError(f"it is cut short, or unpacks to more than {MOST_BYTES >> 20} MB")
    return text


def _check(text: bytes, path: Path) -> None:
    """Whether the text is a complete vocabulary; its own loader would run on with whatever it finds.

    Raises:
        TrackerError: Names the first line that is wrong.
    """
    lines = text.splitlines()
    header = lines[0].split() if lines else []
    try:
        branching, depth, _, _ = map(int, header)
        fits = 2 <= branching <= 20 and 1 <= depth <= 10
    except ValueError:
        fits = False
    if not fits:
        shown = b" ".join(header)[:40].decode(errors="replace")
        raise TrackerError(
            f"orbslam3: {path} is no ORB vocabulary: line 1 is '{shown}', not '<branching> <depth> <score> <weight>'",
            HINT,
        )
    nodes = lines[1:]
    while nodes and not nodes[-1].strip():
        nodes.pop()
    fault = _first_fault(nodes)
    if fault:
        raise TrackerError(f"orbslam3: the vocabulary {path} ({len(lines)} lines) is damaged: {fault}", HINT)


def _first_fault(nodes: Iterable[bytes]) -> str:
    """What is wrong with the tree, or an empty string; node 0 is the root, node i stands in line i + 1."""
    childless = {0}
    leaves = 0
    for node, line in enumerate(nodes, start=1):
        tokens = line.split()
        if len(tokens) != TOKENS or not b"".join(tokens[:-1]).isdigit():
            return f"line {node + 1} is not a node of {TOKENS} numbers"
        parent = int(tokens[0])
        if parent >= node:
            return f"line {node + 1} names parent {parent}, which has not come yet"
        childless.discard(parent)
        if tokens[1] == b"0":
            childless.add(node)
        else:
            leaves += 1
    if childless:
        return f"{len(childless)} inner nodes have no children, as if its end were missing"
    return "" if leaves else "it has no words"
