"""The address of a study's storage: which ones are known, and what of it may be written down."""

from __future__ import annotations

from urllib.parse import unquote, urlsplit

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.passwords import HIDDEN, without_passwords

SCHEMES = ("sqlite", "postgresql", "mysql", "mariadb", "oracle", "mssql", "grpc")
"""SQL databases (also with a driver: ``postgresql+psycopg``) and Optuna's gRPC proxy; they hold data, never code."""


def check_scheme(address: str) -> None:
    """Raise `StudyError` unless the storage is of a kind that keeps plain data (Optuna unpickles what Redis holds)."""
    scheme = address.partition("://")[0].partition("+")[0]
    if "://" not in address or scheme not in SCHEMES:
        raise StudyError(
            f"the storage {without_passwords(address)!r} is of no kind that is known", f"one of {', '.join(SCHEMES)}"
        )


def without_password(text: str, address: str) -> str:
    """A text, for example a driver's message, without the password that an address holds."""
    try:
        password = urlsplit(address).password or ""
    except ValueError:
        password = ""
    for secret in {password, unquote(password)} - {""}:
        text = text.replace(secret, HIDDEN)
    return without_passwords(text)
