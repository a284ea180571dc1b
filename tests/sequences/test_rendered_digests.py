"""Rendered scenes have the same bits on every machine: digests of pixels and poses, which are stored here."""

import hashlib
import hmac
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dynslam_bench.core import SequenceError
from dynslam_bench.sequences.synthetic import TUNE_SCENES, open_synthetic, parse_synthetic_id
from dynslam_bench.sequences.synthetic.sealed import SALT_VARIABLE, parse_salt, sealed_scene

STORED = Path(__file__).parent / "rendered_digests.json"
"""Id and frames to the digest of what is rendered: of each group of families one, with scenes of both splits."""
SALT = "00112233445566778899aabbccddeeff" * 2
_PRINT = """
import json, sys
from dynslam_bench.sequences.synthetic import open_synthetic
from dynslam_bench.sequences.synthetic.digests import rendered_digest

threads = int(sys.argv[1])
names = json.loads(sys.argv[2])
digests = {}
for name in names:
    sequence, _, frames = name.partition(" ")
    rendered = open_synthetic(sequence, None, threads=threads)
    digests[name] = rendered_digest(rendered, [int(index) for index in frames.split(",")])
print(json.dumps(digests))
"""
"""Renders what is named, without a cache of frames, and prints the digests."""
SETTINGS = {
    "this processor, one thread": ({}, 1),
    "this processor, two threads": ({}, 2),
    "numba for x86-64 without AVX and FMA": ({"NUMBA_CPU_NAME": "generic"}, 1),
    "no dispatch in OpenCV, numpy and libc": (
        {
            "OPENCV_CPU_DISABLE": "SSE4_1,SSE4_2,AVX,FP16,AVX2,FMA3,AVX_512F,AVX512_SKX,AVX512_ICL",
            "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX2,-FMA,-AVX",
        },
        2,
    ),
}
"""Environment variables and threads of the renderer."""


@pytest.mark.slow
@pytest.mark.parametrize("settings", SETTINGS)
def test_scenes_have_the_stored_bits(settings: str) -> None:
    environment, threads = SETTINGS[settings]
    if "GLIBC_TUNABLES" in environment:
        found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
        environment = environment | {"NPY_DISABLE_CPU_FEATURES": " ".join(found)}
    stored = json.loads(STORED.read_text())
    done = subprocess.run(
        [sys.executable, "-c", _PRINT, str(threads), json.dumps(list(stored))],
        env=os.environ | environment,
        text=True,
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == stored


def test_the_number_of_a_sealed_scene_is_an_hmac(monkeypatch: pytest.MonkeyPatch) -> None:
    code = hmac.new(bytes.fromhex(SALT), b"2026a/walking_xyz/17", hashlib.sha256).hexdigest()
    number = int(code[:16], 16)
    assert sealed_scene(parse_salt(SALT), "2026a", "walking_xyz", 17) == number
    monkeypatch.setenv(SALT_VARIABLE, SALT.upper() + "\n")
    parsed = parse_synthetic_id("synthetic/walking_xyz?scene=sealed:2026a/17&frames=60")
    assert str(parsed) == f"synthetic/walking_xyz?scene={number}&frames=60"
    assert parse_synthetic_id("synthetic/walking_xyz@sealed:2026a/17").scene == number
    other = parse_synthetic_id("synthetic/sitting_xyz?scene=sealed:2026a/17")
    assert other.scene not in (number, *TUNE_SCENES)
    assert other.split == "held-out"


@pytest.mark.parametrize(
    ("salt", "words"),
    [
        (SALT[:-1], "has 63 .* expected 64"),
        (SALT + "00", "has 66"),
        ("salt" * 16, "no hexadecimal"),
    ],
)
def test_a_salt_of_another_form_is_refused(salt: str, words: str) -> None:
    with pytest.raises(SequenceError, match=words):
        parse_salt(salt)


def test_every_number_of_64_bits_is_a_scene() -> None:
    last = open_synthetic(f"synthetic/objects_balloon?scene={2**64 - 1}&frames=3", None)
    before = open_synthetic(f"synthetic/objects_balloon?scene={2**64 - 2}&frames=3", None)
    low = open_synthetic(f"synthetic/objects_balloon?scene={2**32 - 1}&frames=3", None)
    assert len({str(sequence.ground_truth.T_world_cam) for sequence in (last, before, low)}) == 3
    assert last.split == "held-out"
    assert last.scene_digest() != before.scene_digest()
