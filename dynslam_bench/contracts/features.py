"""The contract of feature extractors: keypoints with binary descriptors, as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Features of one image, one row each.

    Attributes:
        xy: float32 ``[N, 2]``, pixels of the image as given (distorted, full resolution).
        octave: int32 ``[N]``, pyramid level, 0 is full resolution.
        angle: float32 ``[N]``, orientation in degrees, [0, 360).
        response: float32 ``[N]``, corner strength.
        descriptors: uint8 ``[N, B]``, packed bits (ORB: B = 32).
    """

    xy: NDArray[np.float32]
    octave: NDArray[np.int32]
    angle: NDArray[np.float32]
    response: NDArray[np.float32]
    descriptors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.xy)

    def select(self, index: NDArray[np.integer] | NDArray[np.bool_]) -> Keypoints:
        """The keypoints at an index or mask."""
        return Keypoints(
            self.xy[index],
            self.octave[index],
            self.angle[index],
            self.response[index],
            self.descriptors[index],
        )


@dataclass(frozen=True)
class FeatureSpec:
    """Announces a feature extractor; importable without torch or OpenCV.

    Attributes:
        id: Name that `FeatureSettings.extractor` takes.
        entry_point: ``"module:factory"``; called as ``factory(settings: FeatureSettings)``, returns
            a `FeatureExtractor`.
        summary: One line.
        descriptor_bytes: Length of a descriptor, packed bits compared by Hamming distance.
        license: SPDX id or remark.
    """

    id: str
    entry_point: str
    summary: str = ""
    descriptor_bytes: int = 32
    license: str = ""


@runtime_checkable
class FeatureExtractor(Protocol):
    """Finds keypoints; deterministic.

    The pipeline enlarges images narrower than 640 pixels before, and divides the keypoints' pixels
    afterwards.
    """

    def extract(self, gray: NDArray[np.uint8]) -> Keypoints:
        """The keypoints of a uint8 ``[H, W]`` image; none is an empty result."""


@runtime_checkable
class MaskedExtractor(FeatureExtractor, Protocol):
    """An extractor that can ask for more keypoints outside a mask."""

    def extract_masked(
        self, gray: NDArray[np.uint8], mask: NDArray[np.bool_], share: float
    ) -> Keypoints:
        """Extract keypoints, with enough of them outside the mask.

        Where fewer than `share` of the keypoints sought lie outside, as many as are sought in all are
        extracted there, beside those on the mask.

        Args:
            gray: uint8 ``[H, W]``.
            mask: bool ``[H, W]``, True on what moves, e.g. people, whose keypoints will not be used.
            share: Least share outside of the keypoints sought, in [0, 1].

        Returns:
            The keypoints of `extract` on the mask, and outside it those of `extract` or as many as
            it would find if nothing else were in the image; in the order of `extract`.
        """
