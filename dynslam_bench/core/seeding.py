"""Every random number comes from one seed, through named streams that do not disturb each other."""

import hashlib

import numpy as np


def stream(seed: int, *names: str | int) -> np.random.Generator:
    """A generator for one purpose, a function of the seed and the purpose's name only.

    Args:
        seed: The run's seed, a non-negative integer.
        *names: What the stream is for, e.g. ``stream(seed, "flow", frame_index)``.

    Returns:
        A PCG64 generator; equal arguments give equal streams on every platform and Python version.
    """
    # the purpose's name as four words of 32 bits, beside the two words of the seed
    digest = hashlib.sha256("\x1f".join(map(str, names)).encode()).digest()
    words = [int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4)]
    return np.random.default_rng(np.random.SeedSequence([seed & 0xFFFFFFFF, seed >> 32, *words]))


def derive_seed(rng: np.random.Generator) -> int:
    """Draw a 63-bit seed from a generator, for the `stream`s of a component."""
    return int(rng.integers(0, 2**63 - 1))
