"""Runs as bytes: made on a machine that does not share the results folder, and taken into a store."""

import contextlib
import io
import json
import re
import socket
import zipfile
from pathlib import Path
from typing import Any

from dynslam_bench.core import (
    DynslamError,
    InfrastructureError,
    RunError,
    TemporaryFolder,
    translate_errors,
)
from dynslam_bench.core.fingerprint import path_digest
from dynslam_bench.evaluation import Protocol
from dynslam_bench.runs.identity import ResolvedRun, resolve
from dynslam_bench.runs.own_code import is_file, module_of
from dynslam_bench.runs.record import RunRecord
from dynslam_bench.runs.running import run_one
from dynslam_bench.runs.spec import RunSpec
from dynslam_bench.runs.store import RunStore

_PACKED_NAME = re.compile(
    r"(runs|sequences)/([0-9a-f]{16}(?:[0-9a-f]{4})?)/([A-Za-z0-9_]+\.[a-z0-9]+)"
)
"""The name of a file in the archive of a packed run."""


def expected_identity(run: ResolvedRun) -> dict[str, Any]:
    """The identity that a worker has to find where it looks a run up, with the digests of the plug-ins' files.

    A plug-in's file counts in the identity as it is read, which is after the run.
    """
    parts = [part for part in run.identity["parts"] if is_file(part)]
    files = {part: path_digest(Path(run.base_folders.path(module_of(part)))) for part in parts}
    return run.identity | {"plug-ins": files}


def run_packed(
    spec_json: str, protocol_json: str, identity_json: str, *, at_a_time: int = 1
) -> bytes:
    """Make a run on a worker that does not share the results folder; the function that executors are handed.

    Args:
        spec_json: A `RunSpec` as JSON.
        protocol_json: The protocol of the partial metrics as JSON.
        identity_json: The run's identity where it was asked for, as JSON.
        at_a_time: Runs that share this machine.

    Returns:
        A zip archive with the run's folder and its sequence's stamps and ground truth, for
        `unpack`.

    Raises:
        RunError: The request names something that this worker does not have, or its code, packages
            or data are others.
    """
    name = f"worker {socket.gethostname()}"
    # the run has to be the same here as where it was asked for
    try:
        resolved = resolve(RunSpec.model_validate_json(spec_json))
    except DynslamError as error:
        raise RunError(f"{name} cannot make the run: {error.args[0]}", error.hint) from error
    asked = json.loads(identity_json)
    here = expected_identity(resolved)
    differing = [
        key for key in sorted(asked | here) if asked.get(key) != here.get(key) and key != "machine"
    ]
    if differing:
        raise RunError(
            f"{name} would make another run: {', '.join(differing)} differ",
            "give all workers the same code, packages and data",
        )
    write_errors = translate_errors(
        InfrastructureError, f"{name} cannot write its temporary files", "check the free space"
    )
    with write_errors, contextlib.closing(TemporaryFolder()) as folder:
        store = RunStore(folder.path)
        store.prepare()
        protocol = Protocol.model_validate_json(protocol_json)
        return pack(store, run_one(resolved, store, protocol=protocol, at_a_time=at_a_time))


def pack(store: RunStore, record: RunRecord) -> bytes:
    """A stored run with its sequence's part as a zip archive."""
    folders = (store.folder(record.run_id), store.sequences.folder(record.sequence.part))
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for folder in folders:
            for file in sorted(folder.iterdir()):
                archive.write(file, str(file.relative_to(store.root)))
    return buffer.getvalue()


def unpack(data: bytes, store: RunStore) -> RunRecord:
    """Take a packed run into a store; nothing of it is executed, and nothing lands outside the store.

    Raises:
        RunError: The bytes are no packed run, or hold names that do not belong there.
    """
    write_errors = translate_errors(
        InfrastructureError, "cannot unpack a run that a worker has made", "check the free space"
    )
    with write_errors, contextlib.closing(TemporaryFolder()) as folder:
        sent = RunStore(folder.path)
        with (  # zipfile raises almost anything over damaged archives
            translate_errors(
                RunError, f"{len(data)} bytes from a worker are no packed run", of=Exception
            ),
            translate_errors(
                InfrastructureError, f"cannot write {folder.path}", "check the free space"
            ),
            zipfile.ZipFile(io.BytesIO(data)) as archive,
        ):
            names = archive.namelist()
            strange = [name for name in names if not _PACKED_NAME.fullmatch(name)]
            archive.extractall(folder.path, set(names).difference(strange))
        runs = sent.ids()
        if strange or len(runs) != 1:
            raise RunError(f"a packed run holds {len(runs)} runs, and {len(strange)} odd names")
        return store.copy_from(sent, sent.read_whole(runs[0]))
