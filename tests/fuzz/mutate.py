"""Damage to files: bytes, numbers and words of any format, nodes of JSON, chunks of PNG; repeatable by its seed."""

import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from random import Random
from typing import Any

WORDS = [
    *(
        b"",
        b"-1",
        b"0",
        b"nan",
        b"-inf",
        b"1e400",
        b"0x10",
        b"9" * 400,
        b"9" * 5000,
        b"4294967295",
        b"18446744073709551616",
    ),
    *(
        b"null",
        b"true",
        b"[]",
        b"{}",
        b'""',
        b'"\\ud800"',
        b"\xff\xfe",
        b"\xed\xa0\x80",
        b"\x00",
        b"\r",
        b"\xe2\x80\xa8",
    ),
    *(
        b"[" * 3000,
        b'{"a":' * 3000,
        b"a.b.c = 1\n",
        b"../../../../etc/passwd",
        b"/etc/passwd",
        b"\x1b[2J",
        b",",
        b"#",
        b"\n\n",
    ),
]
"""Put in place of a number or a word, or anywhere."""
VALUES: list[Any] = [
    *(
        None,
        True,
        -1,
        0,
        2**63,
        10**400,
        -(10**400),
        1e308,
        float("nan"),
        float("inf"),
        -float("inf"),
        "",
        "nan",
        "a" * 300,
    ),
    *(
        "\ud800",
        "\x1b[31m",
        "../../etc",
        "/etc/passwd",
        [],
        {},
        [[]],
        {"": {}},
        [0] * 50,
        {"counts": [10**12], "size": [1, 1]},
    ),
]
"""Put in place of a node of JSON."""
_TOKEN = re.compile(rb"[-+]?[0-9][0-9.eE+-]*|[A-Za-z_]+")


def mutate(data: bytes, others: list[bytes], random: Random) -> bytes:
    """One to four damages to some bytes; `others` are spliced in."""
    for _ in range(random.choice((1, 1, 1, 2, 3, 4))):
        data = random.choice((*[_replace_part] * 3, _replace_token, _move_line))(
            data, others, random
        )
    return data[: 1 << 22]


def mutate_json(data: bytes, random: Random) -> bytes:
    """One to three nodes of a JSON text deleted, doubled or replaced; other bytes come back as they are."""
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return data
    for _ in range(random.choice((1, 1, 2, 3))):
        value = _changed(value, random)
    return json.dumps(value).encode()


def mutate_lines(data: bytes, random: Random) -> bytes:
    """Apply `mutate_json` to one line of a file of JSON lines."""
    lines = data.split(b"\n")
    at = random.randrange(len(lines))
    lines[at] = mutate_json(lines[at], random)
    return b"\n".join(lines)


def zipped(files: Mapping[str | zipfile.ZipInfo, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """A zip archive of files by their names."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content, method)
    return buffer.getvalue()


def mutate_zip(data: bytes, random: Random) -> bytes:
    """A sound zip archive with right checksums, one of whose files or names is damaged."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as old:
            sizes = {entry.filename: entry.file_size for entry in old.infolist()}
            files = {
                name: old.read(name) if size < 1 << 16 else b"" for name, size in sizes.items()
            }
        name = random.choice(list(files))
        content = files.pop(name)
        content = random.choice((mutate_json(content, random), mutate(content, [content], random)))
        name = random.choice(
            (name, name, name, "../x.txt", "/etc/passwd", f"runs/{'0' * 16}/run.json")
        )
        return zipped(files | {name: content})
    except Exception:  # a seed that is no archive any more is damaged as bytes
        return mutate(data, [data], random)


def mutate_png(data: bytes, random: Random) -> bytes:
    """One chunk of a PNG damaged under a right checksum, so that the decoder goes on to read it."""
    if not data.startswith(b"\x89PNG"):
        return data
    position = 8
    chunks = []
    while position + 12 <= len(data):
        end = position + 8 + struct.unpack_from(">I", data, position)[0]
        chunks.append(data[position + 4 : end])
        position = end + 4
    if not chunks:
        return data
    at = random.randrange(len(chunks))
    kind = chunks[at][:4]
    body = chunks[at][4:]
    damaged = mutate(body, [], random)
    if random.random() < 0.3:  # the compressed pixels themselves
        with suppress(zlib.error):
            damaged = zlib.compress(mutate(zlib.decompress(body), [], random), 1)
    chunks[at] = kind + damaged
    if random.random() < 0.1:
        chunks.insert(random.randrange(len(chunks)), random.choice(chunks))
    return data[:8] + b"".join(png_chunk(chunk) for chunk in chunks)


def png_chunk(content: bytes) -> bytes:
    """A chunk of a PNG, of its kind and body, with its length and a right checksum."""
    return struct.pack(">I", len(content) - 4) + content + struct.pack(">I", zlib.crc32(content))


def _changed(value: Any, random: Random) -> Any:
    if isinstance(value, dict) and value and random.random() < 0.85:
        key = random.choice(list(value))
        if random.random() < 0.12:
            return {name: each for name, each in value.items() if name != key}
        renamed = (
            random.choice(["", "x", key * 2, "\ud800", "__class__"])
            if random.random() < 0.05
            else key
        )
        return {
            **{k: v for k, v in value.items() if k != key},
            renamed: _changed(value[key], random),
        }
    if isinstance(value, list) and value and random.random() < 0.85:
        at = random.randrange(len(value))
        if random.random() < 0.15:
            return value[:at] + value[at + 1 :]
        if random.random() < 0.1:
            return value * 2
        return [*value[:at], _changed(value[at], random), *value[at + 1 :]]
    return random.choice(VALUES)


def _replace_part(data: bytes, others: list[bytes], random: Random) -> bytes:
    """Bytes removed, doubled, overwritten by numbers that are often too much, or replaced by a word or another file."""
    start = random.randrange(len(data) + 1)
    length = random.choice((0, 0, 1, 1, 2, 4, 8, 64, 512, len(data)))
    part = data[start : start + length]
    other = random.choice(others or [data])
    flipped = bytes(byte ^ (1 << random.randrange(8)) for byte in part[:1]) + part[1:]
    replacements = (
        b"",
        flipped,
        random.randbytes(len(part)),
        b"\xff" * len(part),
        bytes(len(part)),
        part * 2,
        part * 50,
        random.choice(WORDS),
        other[random.randrange(len(other) + 1) :],
    )
    return data[:start] + random.choice(replacements) + data[start + length :]


def _replace_token(data: bytes, _: list[bytes], random: Random) -> bytes:
    found = list(_TOKEN.finditer(data[:20000]))
    if not found:
        return data
    token = random.choice(found)
    return data[: token.start()] + random.choice(WORDS) + data[token.end() :]


def _move_line(data: bytes, _: list[bytes], random: Random) -> bytes:
    lines = data.split(b"\n")
    line = lines.pop(random.randrange(len(lines)))
    lines.insert(random.randrange(len(lines) + 1), line)
    return b"\n".join(lines)
