"""Labelled images for training and evaluation: what they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class LabelledImage:
    """An image and its objects.

    Attributes:
        rgb: uint8 ``[H, W, 3]``.
        masks: bool ``[K, H, W]``.
        class_names: COCO name of each object.
    """

    rgb: NDArray[np.uint8]
    masks: NDArray[np.bool_]
    class_names: tuple[str, ...]


class LabelledImages(Protocol):
    """A set of labelled images, decoded or rendered when asked for."""

    @property
    def name(self) -> str:
        """Says what the images are, for records."""
        ...

    @property
    def version(self) -> str:
        """Changes when the content of the images changes under the same name."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> LabelledImage: ...
