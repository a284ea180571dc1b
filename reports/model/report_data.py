"""What a report was made of, as it lies beside it: `report.json`."""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import ClassVar

from pydantic import Field

from dynslam_bench.core.files import write_lines
from dynslam_bench.core.reading import TABLE_BYTES
from dynslam_bench.core.records import Record, schema

from .row import RunRow

REPORT_FILE = "report.json"
SCHEMA_VERSION = 1


class ReportData(Record):
    """What a report was made of; `compare` reads it back.

    Attributes:
        schema_version: Of this record.
        title: Title of the report.
        protocol: Description of the protocol.
        reference: Tracker that errors are divided by.
        version: Version of the package.
        rows: One a run.
    """

    most_bytes: ClassVar[int] = TABLE_BYTES

    schema_version: int = schema(SCHEMA_VERSION)
    title: str
    protocol: str
    reference: str
    version: str
    rows: list[RunRow] = Field(default_factory=list)

    def write(self, path: Path) -> None:
        """Write it with a line for every row; it is never one text, since there may be a hundred thousand rows.

        Raises:
            DynslamError: The folder cannot be written.
        """
        head = self.model_copy(update={"rows": []}).to_line().removesuffix("]}")
        last = len(self.rows) - 1
        rows = (row.to_line() + "," * (at < last) for at, row in enumerate(self.rows))
        write_lines(path, chain([head], rows, ["]}"]))
