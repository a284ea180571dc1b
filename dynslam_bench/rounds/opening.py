"""`new_round`: the salt is drawn, and the round with the salt's SHA-256 is written."""

import hashlib
import os
import secrets
from collections.abc import Sequence
from pathlib import Path

from dynslam_bench.core import RunError, read_text, translate_errors, write_atomic
from dynslam_bench.core.records import validated
from dynslam_bench.evaluation import get_protocol
from dynslam_bench.rounds.bits import probe_digests
from dynslam_bench.rounds.files import ROUND_FILE, Round, renderer_versions
from dynslam_bench.runs.store import DEFAULT_PROTOCOL
from dynslam_bench.sequences.synthetic.sealed import SALT_BYTES

_COMPUTED = ("index.sqlite", "report/", ".*.claim", ".merging")
"""Files that can be computed again at any time: no part of a repository."""


def new_round(
    folder: str | Path,
    *,
    name: str,
    families: Sequence[str],
    scenes: int,
    frames: int,
    protocol: str = DEFAULT_PROTOCOL,
    deadline: str = "",
    rules: str = "",
    tolerance: float = 0.1,
    salt_file: str | Path | None = None,
) -> Round:
    """Draw a salt, and write the round that commits to it.

    Args:
        folder: The round's folder; it is made where there is none.
        name: Name of the round.
        families: Names of rendered sequences.
        scenes: Sealed scenes of each family.
        frames: Frames of each scene.
        protocol: How errors are computed.
        deadline: Until when entries are received, ISO 8601 with a time zone; empty for until the
            reveal.
        rules: What else holds, in words.
        tolerance: Share by which the errors of a reproduced row may differ.
        salt_file: Where the salt goes, which is kept secret until the reveal; ``FOLDER.salt`` by
            default.

    Raises:
        RunError: A value does not fit, or one of the files exists.
    """
    root = Path(folder).expanduser().absolute()
    salt_path = salt_place(folder, salt_file)
    if (root / ROUND_FILE).exists():
        raise RunError(f"{root / ROUND_FILE} exists already", "name another folder")
    if salt_path.is_relative_to(root.resolve()):
        raise RunError(
            f"the salt {salt_path} would lie in the round's folder, which is published",
            "name another place: --salt FILE",
        )
    # everything but the salt is checked before one is drawn
    values = {
        "name": name,
        "families": list(families),
        "scenes": scenes,
        "frames": frames,
        "protocol": protocol,
        "protocol_digest": get_protocol(protocol).digest(),
        "deadline": deadline,
        "rules": rules,
        "tolerance": tolerance,
        "salt_sha256": "0" * 64,
        "renderer": {},
        "probes": {},
    }
    draft = validated(Round, values, "the round", RunError)

    salt = secrets.token_bytes(SALT_BYTES)
    made = draft.model_copy(
        update={
            "salt_sha256": hashlib.sha256(salt).hexdigest(),
            "renderer": renderer_versions(draft.families),
            "probes": probe_digests(draft.families),
        }
    )
    # only its owner may read the salt
    with translate_errors(RunError, f"cannot write {salt_path}", "name another place: --salt FILE"):
        descriptor = os.open(salt_path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w", encoding="ascii") as file:
            file.write(salt.hex() + "\n")
    write_atomic(root / ROUND_FILE, made.to_json())
    _extend_gitignore(root / ".gitignore")
    return made


def salt_place(folder: str | Path, salt_file: str | Path | None = None) -> Path:
    """The path of a round's salt, links followed: ``FOLDER.salt`` by default."""
    root = Path(folder).expanduser().absolute()
    return Path(salt_file or f"{root.resolve()}.salt").expanduser().resolve()


def work_tree_of(file: Path) -> Path | None:
    """The git work tree in which a file lies; None for none."""
    return next((folder for folder in file.parents if (folder / ".git").exists()), None)


def _extend_gitignore(file: Path) -> None:
    """Add what can be computed again at any time to a ``.gitignore``; lines that are there stay.

    Raises:
        DynslamError: It cannot be read or written.
    """
    before = read_text(file) if file.is_file() else ""
    missing = [line for line in _COMPUTED if line not in before.splitlines()]
    if before and not before.endswith("\n"):
        before += "\n"
    if missing:
        write_atomic(file, before + "".join(f"{line}\n" for line in missing))
