"""Passwords, tokens and keys never leave the process: not in messages, records, reports or logs."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Any

_PASSWORD = re.compile(r"((?<![\w+.-])[A-Za-z][\w+.-]*://[^\s/?#:@\"']*):[^\s\"']{0,999}@")
_PARAMETER = re.compile(r"([?&;](?:password|passwd|pwd|token|secret|sslpassword)=)[^&;#\s\"']+", re.IGNORECASE)
HIDDEN = "***"
_HINTS = ("passw", "passp", "pwd", "token", "secret", "credential", "apikey", "api-key", "api_key", "accesskey",
          "access-key", "access_key", "privatekey", "private-key", "private_key")  # fmt: skip
"""One of these is in every line that holds a secret by name; they are looked for a hundred times as fast."""
_NAME = r"(?:password|passwd|passphrase|pwd|token|secret|credentials?|(?:api|access|private)[-_]?key)"
_TEXT = r"(?:[^\"\\]|\\.)"
"""A character of a text in JSON."""
_BARE = r"(?:[^\s\"'\\&;#]|\\[^\"'])+"
_QUOTED = r"'[^'\"]*'|\\\"[^\"\\]*\\\""
_ASSIGNED = (
    re.compile(rf"(\"-{{0,2}}[\w.-]{{0,60}}{_NAME}=){_TEXT}+(?=\")", re.IGNORECASE),  # a word of a command in JSON
    re.compile(rf"({_NAME}=)(?:{_QUOTED}|{_BARE})", re.IGNORECASE),
    re.compile(rf"(\"[\w.-]{{0,60}}{_NAME}\"\s*:\s*\"){_TEXT}+(?=\")", re.IGNORECASE),  # a setting in JSON
    re.compile(rf"((?<![\w-])--?[\w-]{{0,60}}{_NAME}\",\s*\")(?!-){_TEXT}+(?=\")", re.IGNORECASE),  # two such words
    re.compile(rf"((?<![\w-])--?[\w-]{{0,60}}{_NAME}(?:\s+|',\s*'))(?!-)(?:{_QUOTED}|{_BARE})", re.IGNORECASE),
)


def without_passwords(text: str) -> str:
    """The text with every password in an address, and every value that its name calls a secret, replaced by ``***``.

    Names end in ``password``, ``token``, ``secret``, ``api-key`` or the like; a value stands behind ``=`` or an option.

    >>> without_passwords("cannot reach postgresql://me:secret@db/studies?sslmode=require")
    'cannot reach postgresql://me:***@db/studies?sslmode=require'
    >>> without_passwords("slam --token=s3cret --api-key s3cret --threads 2")
    'slam --token=*** --api-key *** --threads 2'
    """
    text = _without_addresses_passwords(text)
    if not _lines_with_hints(text):
        return text
    return str(json.loads(_hide(json.dumps(text, ensure_ascii=False))))


def json_without_passwords(text: str) -> str:
    """The same of a text in JSON, which stays JSON; an option and its value may be two texts of a list."""
    text = _without_addresses_passwords(text)
    done, parts = 0, []
    for first, last in _lines_with_hints(text):
        parts += [text[done:first], _hide(text[first:last])]
        done = last
    return "".join([*parts, text[done:]])


def words_without_passwords(words: Sequence[str]) -> list[str]:
    """The same of the words of a command."""
    hidden: Any = json.loads(json_without_passwords(json.dumps(list(words), ensure_ascii=False)))
    return list(hidden)


def _without_addresses_passwords(text: str) -> str:
    return _PARAMETER.sub(rf"\1{HIDDEN}", _PASSWORD.sub(rf"\1:{HIDDEN}@", text)) if "://" in text else text


def _lines_with_hints(text: str) -> list[tuple[int, int]]:
    """Where lines begin and end that may hold a secret, each with the line that follows; in order, none overlaps."""
    lowered = text.lower()
    if len(lowered) != len(text):  # a few letters become two
        return [(0, len(text))]
    found: list[tuple[int, int]] = []
    for hint in _HINTS:
        at = lowered.find(hint)
        while at >= 0:
            line_end = text.find("\n", at)
            end = text.find("\n", line_end + 1) if line_end >= 0 else -1
            found.append((text.rfind("\n", 0, at) + 1, end if end >= 0 else len(text)))
            at = lowered.find(hint, line_end) if line_end >= 0 else -1
    spans: list[tuple[int, int]] = []
    for first, last in sorted(found):
        if spans and first <= spans[-1][1]:
            spans[-1] = spans[-1][0], max(last, spans[-1][1])
        else:
            spans.append((first, last))
    return spans


def _hide(text: str) -> str:
    """A text in JSON, or some lines of one, without the secrets that it names."""
    for pattern in _ASSIGNED:
        text = pattern.sub(rf"\1{HIDDEN}", text)
    return text
