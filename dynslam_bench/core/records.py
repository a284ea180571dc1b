"""Persisted records: validated, versioned, digested, and written so that no half of one is ever seen."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from .errors import DynslamError

R = TypeVar("R", bound="Record")


class Record(BaseModel):
    """Base of everything that is written to disk and read back; unknown keys of newer versions are refused."""

    model_config = ConfigDict(extra="forbid", ser_json_inf_nan="strings")

    def to_json(self) -> str:
        """The record as indented JSON with a final newline."""
        return self.model_dump_json(indent=2) + "\n"

    @classmethod
    def read(cls: type[R], path: Path) -> R:
        """Read and validate a record.

        Raises:
            DynslamError: The file is missing, is not JSON or does not fit the schema; names file and first fault.
        """
        try:
            return cls.model_validate_json(path.read_text())
        except OSError as error:
            raise DynslamError(f"cannot read {path}: {error.strerror}") from error
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"])) or "file"
            raise DynslamError(f"{path} is not a valid {cls.__name__}: {where}: {first['msg']}") from error


def digest(value: Any, length: int = 12) -> str:
    """A short hexadecimal SHA-256 of a JSON-able value or pydantic model; key order does not matter."""
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json")
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:length]


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write a file under a temporary name beside its target, then rename it into place.

    Raises:
        DynslamError: The folder cannot be written (full disk, permissions); nothing is left behind.
    """
    data = content.encode() if isinstance(content, str) else content
    temporary: str | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except OSError as error:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
        raise DynslamError(
            f"cannot write {path}: {error.strerror}", "check the permissions and the free space"
        ) from error


@contextmanager
def atomic_folder(target: Path) -> Iterator[Path]:
    """A temporary folder beside `target` that becomes `target` when the block ends without an error.

    An existing target is replaced. If the block raises, or the process dies, `target` is as it was.

    Raises:
        DynslamError: The parent folder cannot be written.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    except OSError as error:
        raise DynslamError(f"cannot write into {target.parent}: {error.strerror}", "name another folder") from error
    try:
        yield work
        work.chmod(0o755)
        if target.exists():
            stale = Path(tempfile.mkdtemp(prefix=f".{target.name}.old.", dir=target.parent))
            target.replace(stale / "old")
            work.replace(target)
            shutil.rmtree(stale, ignore_errors=True)
        else:
            work.replace(target)
    finally:
        shutil.rmtree(work, ignore_errors=True)
