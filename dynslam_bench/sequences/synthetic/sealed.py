"""Numbers of sealed scenes: nobody knows them before the salt of their round is published."""

import hashlib
import hmac
import os
import re

from dynslam_bench.core import SequenceError

SALT_VARIABLE = "DYNSLAM_BENCH_SALT"
"""Environment variable with the salt by which ``scene=sealed:ROUND/INDEX`` becomes a number."""
SALT_BYTES = 32
"""Bytes of a salt, as many as SHA-256 has: a shorter one would be easier to guess than the hash."""
SCENE_BYTES = 8
"""Bytes of a scene's number: 64 bits."""
ROUND_NAME = r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}"
"""Names of rounds, as a regular expression."""
_SEALED = re.compile(rf"sealed:(?P<round>{ROUND_NAME})/(?P<index>[0-9]{{1,9}})")


def parse_salt(text: str) -> bytes:
    """The bytes of a salt that is written as 64 hexadecimal digits.

    Raises:
        SequenceError: It has another length, or other characters.
    """
    digits = text.strip()
    wanted = 2 * SALT_BYTES
    if not re.fullmatch(r"[0-9a-fA-F]*", digits):
        raise SequenceError(
            "the salt holds characters that are no hexadecimal digits", f"it has {wanted} of 0-9a-f"
        )
    if len(digits) != wanted:
        raise SequenceError(
            f"the salt has {len(digits)} hexadecimal digits, expected {wanted}",
            "copy the whole line",
        )
    return bytes.fromhex(digits)


def sealed_scene(salt: bytes, round_name: str, family: str, index: int) -> int:
    """The number of a sealed scene: the first eight bytes of an HMAC (RFC 2104) with SHA-256, the first the highest.

    The key is the salt. The message is ``ROUND/FAMILY/INDEX`` in ASCII, e.g.
    ``2026a/walking_xyz/17``.

    Args:
        salt: The round's salt.
        round_name: Name of the round.
        family: Name of the rendered sequence, e.g. ``walking_xyz``.
        index: Number of the scene within family and round, from 0.

    Example:
        >>> sealed_scene(bytes(32), "2026a", "walking_xyz", 17)
        547835786748380997
    """
    message = f"{round_name}/{family}/{index}".encode("ascii")
    code = hmac.new(salt, message, hashlib.sha256).digest()
    return int.from_bytes(code[:SCENE_BYTES], "big")


def scene_of_text(text: str, family: str) -> int | None:
    """The number of a scene that is written ``sealed:ROUND/INDEX``; None for a text of another form.

    Raises:
        SequenceError: No salt is set, or what is set is none.
    """
    match = _SEALED.fullmatch(text)
    if match is None:
        return None
    salt = os.environ.get(SALT_VARIABLE, "")
    if not salt:
        raise SequenceError(
            f"scene '{text}' needs the salt of round {match['round']}",
            f"set {SALT_VARIABLE} to the salt in the round's reveal.json, which is written after the deadline",
        )
    return sealed_scene(parse_salt(salt), match["round"], family, int(match["index"]))
