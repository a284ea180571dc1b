"""Persisted records: validated, versioned and digested (`core.files` writes them)."""

import hashlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dynslam_bench.core.errors import DynslamError, did_you_mean
from dynslam_bench.core.reading import RECORD_BYTES, read_text
from dynslam_bench.core.sanitise import json_without_passwords, storable

_PLAIN_NAME = r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}"
Name = Annotated[str, Field(pattern=f"^{_PLAIN_NAME}$")]
"""Names of people, groups and entries, which become names of files."""
AnyRecord = TypeVar("AnyRecord", bound="Record")
Model = TypeVar("Model", bound=BaseModel)
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]
"""Sixteen hexadecimal digits, as `digest` makes them: the name of a sequence's part."""
RunId = Annotated[str, Field(pattern=r"^[0-9a-f]{16}([0-9a-f]{4})?$")]
"""Twenty hexadecimal digits: twelve of what was asked for, eight of what was read for it. Older runs have sixteen."""


def is_plain_name(text: str) -> bool:
    """Whether a text is a `Name`."""
    return re.fullmatch(_PLAIN_NAME, text) is not None


def schema(newest: int) -> Any:
    """A record's field that holds the version of its schema.

    Args:
        newest: The newest version; this package reads it and all before it.
    """
    return Field(default=newest, ge=1, le=newest)


class Record(BaseModel):
    """Base of everything that is written to disk and read back; unknown keys of newer versions are refused."""

    model_config = ConfigDict(extra="forbid", ser_json_inf_nan="strings")
    most_bytes: ClassVar[int] = RECORD_BYTES
    """A larger file is not read."""

    def to_json(self) -> str:
        """The record as indented JSON with a final newline, without passwords and without what UTF-8 cannot hold."""
        return self.to_line(2) + "\n"

    def to_line(self, indent: int | None = None) -> str:
        """The record as JSON without a final newline, without passwords and without what UTF-8 cannot hold.

        Args:
            indent: Spaces of each level; None for one line.
        """
        try:
            text = self.model_dump_json(indent=indent)
        except ValueError:  # half characters, e.g. of a foreign command line
            encodable = type(self).model_validate(storable(self.model_dump()))
            text = encodable.model_dump_json(indent=indent)
        return json_without_passwords(text)

    @classmethod
    def read(cls: type[AnyRecord], path: Path) -> AnyRecord:
        """Read and validate a record.

        Raises:
            DynslamError: The file is missing, too large, no UTF-8, no JSON or does not fit the
                schema; names file and first fault.
        """
        return cls.parse(read_text(path, limit=cls.most_bytes), str(path))

    @classmethod
    def parse(cls: type[AnyRecord], text: str, where: str) -> AnyRecord:
        """Validate a record's JSON.

        Args:
            text: The JSON.
            where: What it is, for messages.

        Raises:
            DynslamError: It is no JSON or does not fit the schema; names the first fault.
        """
        try:
            return cls.model_validate_json(text)
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(map(str, first["loc"])) or "file"
            is_newer = place.endswith("schema_version") and first["type"] == "less_than_equal"
            hint = "a newer dynslam-bench wrote it: upgrade" if is_newer else ""
            raise DynslamError(
                f"{where} is not a valid {cls.__name__}: {place}: {first['msg']}", hint
            ) from error


def validated(cls: type[Model], values: Any, where: str, kind: type[DynslamError]) -> Model:
    """Validate what a user wrote.

    Args:
        cls: The model.
        values: Its fields.
        where: Where they stand, for messages.
        kind: What is raised.

    Raises:
        DynslamError: Raised as `kind`, in one line: an unknown key (with a did-you-mean), or a
            value that does not fit.
    """
    try:
        return cls.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(map(str, first["loc"]))
        if first["type"] == "extra_forbidden":
            raise kind(f"{where}: unknown key '{name}'", did_you_mean(name, _keys(cls))) from None
        # pydantic's prefix of errors that validators raise
        text = first["msg"].removeprefix("Value error, ")
        field = f"{name}: " if name else ""
        raise kind(f"{where}: {field}{text[0].lower()}{text[1:]}") from None


def _keys(cls: type[BaseModel]) -> Iterator[str]:
    """The names of a model's fields, and of those of models in it."""
    for name, field in cls.model_fields.items():
        yield name
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from (f"{name}.{key}" for key in _keys(field.annotation))


def digest(value: Any, length: int = 12) -> str:
    """A short hexadecimal SHA-256 of a JSON-able value or pydantic model; key order does not matter."""
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json")
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:length]
