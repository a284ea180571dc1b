"""What a report was made of, as it lies beside it: `report.json`."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

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
