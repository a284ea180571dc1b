"""What may be wrong with the arrays of a map that somebody else wrote; compiled loops look nothing up unchecked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray[Any]]
Layout = Mapping[str, tuple[str, str]]

MOST_BYTES = 1 << 30
"""Of all features of a map as tables; two thousand keyframes of a thousand features fill a fifth."""
MOST_WORDS = 64
"""Words of 64 bits of a descriptor; ORB's has four."""
_FINITE = ("kf_pose", "kf_raw", "kf_response", "kf_xy", "kf_z", "kf_angle", "kf_info", "kf_info_right", "position",
           "normal", "far", "island_start", "island_anchor")  # fmt: skip
_NOT_BELOW = {"kf_count": 0, "kf_z": 0, "kf_info": 0, "kf_info_right": 0, "visible": 1, "found": 0, "n_obs": 1,
              "kf_octave": 0, "kf_point": -1, "obs_kf": 0, "obs_ft": 0, "kf_id": 0, "kf_island": 0, "id": 0,
              "born": 0, "island_reach": 0}  # fmt: skip


def array_faults(arrays: Arrays, layout: Layout) -> Iterator[str]:
    """Arrays that are missing or too many, of another type or shape; sizes with one letter are the same everywhere.

    Args:
        arrays: The arrays.
        layout: Type, and shape with a letter or digit for each axis, by name.
    """
    for name in sorted(layout.keys() ^ arrays.keys()):
        yield f"it holds no array '{name}'" if name in layout else f"it holds an unknown array '{name[:40]}'"
    sizes: dict[str, int] = {}
    for name, (kind, axes) in layout.items():
        found = arrays[name]
        expected = [int(axis) if axis.isdigit() else sizes.setdefault(axis, size)
                    for axis, size in zip(axes, found.shape, strict=False)]  # fmt: skip
        if found.dtype != np.dtype(kind) or found.ndim != len(axes) or list(found.shape) != expected:
            shape = ", ".join(map(str, expected)) + ", ?" * max(len(axes) - found.ndim, 0)
            yield f"'{name}' is {found.dtype} of shape {str(found.shape)[:60]}, expected {np.dtype(kind)} of ({shape})"


def content_faults(arrays: Arrays, next_keyframe: int, next_point: int, levels: int) -> Iterator[str]:
    """Values out of bounds, and references that lead nowhere or are not answered.

    Args:
        arrays: The arrays, complete and of the right shapes.
        next_keyframe: Number of the next keyframe, above all there are.
        next_point: Number of the next point, likewise.
        levels: Levels of the features' image pyramid.
    """
    for name in _FINITE:
        if not np.isfinite(arrays[name]).all():
            yield f"'{name}' holds values that are not finite"
    for name, least in _NOT_BELOW.items():
        if not (arrays[name] >= least).all():
            yield f"'{name}' holds values below {least}"
    yield from _bounds(arrays, next_keyframe, next_point, levels)
    yield from _references(arrays)


def _bounds(arrays: Arrays, next_keyframe: int, next_point: int, levels: int) -> Iterator[str]:
    if not len(arrays["kf_id"]):
        yield "it holds no keyframe"
    if not (arrays["far"] > 0).all():
        yield "'far' holds values that are not above 0"
    most = {"kf_island": len(arrays["island_reach"]), "kf_octave": levels - 1,
            "kf_id": next_keyframe - 1, "born": next_keyframe - 1, "id": next_point - 1,
            "kf_point": len(arrays["id"]) - 1, "obs_kf": len(arrays["kf_id"]) - 1}  # fmt: skip
    for name, largest in most.items():
        if not (arrays[name] <= largest).all():
            yield f"'{name}' holds values above {largest}"
    for name in ("kf_id", "id"):
        if not (np.diff(arrays[name]) > 0).all():
            yield f"'{name}' is not in ascending order"
    rotation = arrays["kf_pose"][:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3))
        upright = np.linalg.det(rotation) > 0
    if not ((off < 1e-6).all() and upright.all() and (arrays["kf_pose"][:, 3] == [0, 0, 0, 1]).all()):
        yield "'kf_pose' holds what is no rigid transformation"
    if not np.array_equal(np.isnan(arrays["kf_right"]), arrays["kf_z"] == 0) or np.isinf(arrays["kf_right"]).any():
        yield "'kf_right' is not known where depth is, and only there"


def _references(arrays: Arrays) -> Iterator[str]:
    """Features say which point they observe, and points which features observe them; both have to say the same."""
    words = max(arrays["kf_words"].shape[1], arrays["words"].shape[1])
    if words > MOST_WORDS:
        yield f"a descriptor has {words} words of 64 bits, at most {MOST_WORDS} are read"
    count = arrays["kf_count"]
    claimed = len(count) * int(count.max(initial=0)) * (64 + 8 * words)  # as tables, as wide as the longest row
    if claimed > MOST_BYTES:
        yield f"'kf_count' claims tables of {claimed} bytes, at most {MOST_BYTES} are made"
    for name, total in (("kf_count", len(arrays["kf_point"])), ("n_obs", len(arrays["obs_kf"]))):
        counts = arrays[name].astype(np.int64)
        if (counts > total).any() or int(counts.sum()) != total:
            yield f"'{name}' does not add up to {total}"
    keyframe, feature = arrays["obs_kf"], arrays["obs_ft"]
    if not (feature < arrays["kf_count"][keyframe]).all():
        yield "'obs_ft' names features that the keyframe does not have"
    begin = np.cumsum(arrays["kf_count"]) - arrays["kf_count"]
    seen = begin[keyframe] + feature
    said = np.repeat(np.arange(len(arrays["id"])), arrays["n_obs"])
    if len(np.unique(seen)) != len(seen) or not np.array_equal(arrays["kf_point"][seen], said):
        yield "observations do not agree with 'kf_point'"
    if len(np.unique(said * len(arrays["kf_id"]) + keyframe)) != len(seen):
        yield "a keyframe observes a point with two features"
    if np.count_nonzero(arrays["kf_point"] >= 0) != len(seen):
        yield "'kf_point' names points that do not know of it"
