"""The bytes of rendered frames stay what they were, on every processor; who changes them raises a version."""

import ast
import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import dynslam_bench.sequences.synthetic as package
from dynslam_bench.sequences.synthetic import arithmetic, open_synthetic, parse_synthetic_id
from dynslam_bench.sequences.synthetic.settings import RENDERER_VERSION

KEPT = [
    ("synthetic/walking_xyz", 301, 6, 0, "7b29ed5351537f6f"),
    ("synthetic/sitting_rpy@100", 40, 6, 0, "76436bc25ce51d1b"),
    ("synthetic/walking_static@7", 420, 6, 0, "00437b14d025f12e"),
    ("synthetic/loop_room@2", 700, 6, 1, "0761b775516c8b0a"),
    ("synthetic/fast_walking@1", 100, 6, 1, "05c7b5b125b81b77"),
]
"""Id, frame, version of the renderer and of the family, and the hash."""
OTHERWISE = {"sin", "cos", "tan", "arcsin", "arccos", "arctan", "arctan2", "atan", "atan2", "hypot", "exp", "log",
             "power", "pow", "linalg", "dot", "matmul", "einsum", "inner", "tensordot", "vecdot"}  # fmt: skip
"""Functions of numpy and of the C library whose last bit depends on the processor."""


def fingerprint(id: str, index: int, threads: int = 1) -> str:
    """A hash of a frame's colours, depth, masks and flow, and of all poses."""
    sequence = open_synthetic(id, None, threads=threads)
    frame, total = sequence[index], hashlib.sha256()
    flow, poses = sequence.flow(index, index - 1), sequence.ground_truth.T_world_cam
    for part in (frame.rgb, frame.depth, sequence.masks[index].instances, flow, poses):
        total.update(part.tobytes())
    return total.hexdigest()[:16]


@pytest.mark.parametrize(("id", "index", "renderer", "family", "expected"), KEPT)
def test_frames_keep_their_bytes(id: str, index: int, renderer: int, family: int, expected: str) -> None:
    assert (RENDERER_VERSION, parse_synthetic_id(id).variant.version) == (renderer, family), "new bytes: renew the hash"
    assert fingerprint(id, index) == expected


def test_an_older_processor_and_several_threads_render_the_same_bytes() -> None:
    """OpenBLAS's kernels for a Nehalem, numpy without the SIMD that it found, the C library without multiply-adds."""
    extensions = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    older = {
        "OPENBLAS_CORETYPE": "Nehalem",
        "NPY_DISABLE_CPU_FEATURES": " ".join(extensions),
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX2,-FMA,-AVX",
    }
    expected = {(id, index, 3): value for id, index, *_, value in KEPT if "walking_xyz" in id or "loop" in id}
    code = f"from test_synthetic_bytes import fingerprint; print(*(fingerprint(*frame) for frame in {list(expected)}))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(__file__).parent, env=os.environ | older, text=True, capture_output=True
    )
    assert done.stdout.split() == list(expected.values()), done.stderr


def test_nothing_is_rendered_with_what_depends_on_the_processor() -> None:
    """Products and functions come from `arithmetic.py`."""
    found = []
    for path in Path(package.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            product = isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult)
            called = (
                isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in ("np", "math")
            )
            if product or (called and node.attr in OTHERWISE):
                found.append(f"{path.name}:{node.lineno}")
    assert not found


def test_functions_and_products_are_those_of_numpy_to_the_last_digit() -> None:
    rng, right = np.random.default_rng(0), np.pi / 2
    x, y = rng.uniform(-2e5, 2e5, 5000), rng.normal(size=5000)
    a, b = rng.normal(size=(2, 7, 3, 3))
    for ours, theirs in (
        (arithmetic.sin(x), np.sin(x)),
        (arithmetic.cos(x), np.cos(x)),
        (arithmetic.exp(y), np.exp(y)),
        (arithmetic.arctan2(y, x), np.arctan2(y, x)),
        (arithmetic.arctan2(np.array([0.0, 0, 1, -1]), np.array([0.0, -1, 0, 0])), [0, np.pi, right, -right]),
        (np.array([arithmetic.power(v, 0.7) for v in abs(x)]), abs(x) ** 0.7),
        (arithmetic.norm(a), np.linalg.norm(a, axis=-1)),
        (arithmetic.product(a, b, a[0]), a @ b @ a[0]),
        (arithmetic.product(a, b[0, 0]), a @ b[0, 0]),
        (arithmetic.product(a[0, 0], b), a[0, 0] @ b),
        (arithmetic.product(a[0, 0], b[0, 0]), a[0, 0] @ b[0, 0]),
    ):  # fmt: skip
        np.testing.assert_allclose(ours, theirs, rtol=2e-15, atol=3e-15)
    assert (arithmetic.sin(0.3), arithmetic.power(0.0, 0.7)) == (pytest.approx(np.sin(0.3), abs=3e-16), 0.0)
