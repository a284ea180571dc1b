"""Passwords in addresses never leave the process: not in messages, records, reports or logs."""

from __future__ import annotations

import re

_PASSWORD = re.compile(r"((?<![\w+.-])[A-Za-z][\w+.-]*://[^\s/?#:@\"']*):[^\s\"']{0,999}@")
_PARAMETER = re.compile(r"([?&;](?:password|passwd|pwd|token|secret|sslpassword)=)[^&;#\s\"']+", re.IGNORECASE)
HIDDEN = "***"


def without_passwords(text: str) -> str:
    """The text with ``scheme://name:PASSWORD@host`` and ``?password=...`` of every address in it replaced by ``***``.

    >>> without_passwords("cannot reach postgresql://me:secret@db/studies?sslmode=require")
    'cannot reach postgresql://me:***@db/studies?sslmode=require'
    """
    return _PARAMETER.sub(rf"\1{HIDDEN}", _PASSWORD.sub(rf"\1:{HIDDEN}@", text)) if "://" in text else text
