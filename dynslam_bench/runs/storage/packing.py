"""A run as bytes, for workers that do not share the results folder."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shutil
import struct
import zipfile
import zlib
from pathlib import Path

from dynslam_bench.core.errors import RunError
from dynslam_bench.core.records import write_atomic
from dynslam_bench.core.temporary import TemporaryFolder
from dynslam_bench.evaluation.protocol import Protocol

from ..one import run_one
from ..spec import RunSpec
from .record import RunRecord
from .store import RUN_FILE, RunStore

_ENTRY = re.compile(r"(runs|sequences)/([0-9a-f]{16})/([A-Za-z0-9_]+\.[a-z0-9]+)")
_LARGEST = 2**31
_MAX_RATIO = 200
"""Most bytes that a byte of the archive may unpack to."""
_SLACK = 1 << 24
# What Python's zipfile raises over damaged archives.
_DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, NotImplementedError, RuntimeError, LookupError,
           ValueError, TypeError, OverflowError)  # fmt: skip


def run_packed(spec_json: str, options_json: str = "{}") -> bytes:
    """Make a run on a worker; the function that executors are handed.

    Args:
        spec_json: A `RunSpec` as JSON.
        options_json: Keyword arguments of `run_one` as JSON, a protocol as its fields.

    Returns:
        A zip archive with the run's folder and its sequence's stamps and ground truth, for `unpack`.

    Raises:
        DynslamError: The request names something that this worker does not have.
    """
    spec = RunSpec.model_validate_json(spec_json)
    options = json.loads(options_json)
    if "protocol" in options:
        options["protocol"] = Protocol.model_validate(options["protocol"])
    with contextlib.closing(TemporaryFolder()) as folder:
        store = RunStore(folder.path)
        store.prepare()
        record = run_one(spec, store, **options)
        return pack(store, record)


def pack(store: RunStore, record: RunRecord) -> bytes:
    """A stored run with its sequence's part as a zip archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for folder in (store.folder(record.run_id), store.root / "sequences" / record.sequence.part):
            for file in sorted(folder.iterdir()):
                archive.write(file, str(file.relative_to(store.root)))
    return buffer.getvalue()


def unpack(data: bytes, store: RunStore) -> RunRecord:
    """Take a packed run into a store; nothing of it is executed, and nothing lands outside the store.

    Raises:
        RunError: The bytes are no packed run, or hold names that do not belong there.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return _take(archive, store, min(_LARGEST, _SLACK + _MAX_RATIO * len(data)))
    except _DAMAGE as error:
        raise RunError(f"{len(data)} bytes from a worker are no packed run: {error}") from error


def _take(archive: zipfile.ZipFile, store: RunStore, largest: int) -> RunRecord:
    entries = archive.infolist()
    size = sum(entry.file_size for entry in entries)
    if size > largest:
        raise RunError(f"a packed run holds {size / 1e9:.1f} GB, at most {largest / 1e9:.1f} GB are taken")
    if any(entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for entry in entries):
        raise RunError("a packed run is compressed in a way that pack() does not use")
    matches = {entry.filename: _ENTRY.fullmatch(entry.filename) for entry in entries}
    odd = [name for name, match in matches.items() if match is None]
    runs = {match[2] for match in matches.values() if match is not None and match[1] == "runs"}
    if odd or len(runs) != 1:
        raise RunError(f"a packed run holds {odd[0] if odd else f'{len(runs)} runs'}", "it was not made by pack()")
    run_id = runs.pop()
    with store.work_folder(run_id) as work:
        for name, match in matches.items():
            assert match is not None
            if match[1] == "runs":
                with archive.open(name) as source, (work / match[3]).open("wb") as file:
                    shutil.copyfileobj(source, file)
        record = RunRecord.read(work / RUN_FILE)
        if record.run_id != run_id:
            raise RunError(f"a packed run names itself {record.run_id} but lies under {run_id}")
        for name, match in matches.items():
            if match is not None and match[1] == "sequences" and match[2] == record.sequence.part:
                _write_once(store.root / "sequences" / match[2] / match[3], archive.read(name))
        record = store.publish(work, record)
    return record


def _write_once(path: Path, data: bytes) -> None:
    if not path.is_file():
        write_atomic(path, data)
