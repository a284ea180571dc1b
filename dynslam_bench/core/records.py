"""Persisted records: validated, versioned and digested (`core.files` writes them)."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from .errors import DynslamError
from .files import atomic_folder, write_atomic

__all__ = ["Record", "atomic_folder", "digest", "write_atomic"]

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
