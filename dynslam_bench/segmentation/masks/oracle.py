"""Exact masks of rendered (or annotated) sequences, as if a perfect network had found them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.contracts.sequence import Frame, FrameMasks, MaskSource
from dynslam_bench.core.errors import SegmentationError

from ..networks.images import boxes_of, check_mask_shape


def instances_of(masks: FrameMasks, *, where: str = "masks") -> Instances:
    """The objects of a label image, with exact boxes and score 1.

    Args:
        masks: Label image with class names and the set of moving ids.
        where: Named in the error.

    Returns:
        One row an id that is visible and has a class name, in order of id. `Instances.moving` is filled.

    Raises:
        SegmentationError: An id in the image has no class name.
    """
    labels = np.asarray(masks.instances)
    ids = [int(number) for number in np.unique(labels) if number != 0]
    nameless = [number for number in ids if number not in masks.class_names]
    if nameless:
        raise SegmentationError(
            f"{where}: instance {nameless[0]} has no class name",
            "known ids: " + (", ".join(map(str, sorted(masks.class_names))) or "none"),
        )
    if not ids:
        empty = Instances.empty(labels.shape[0], labels.shape[1])
        return Instances(empty.masks, empty.boxes, (), empty.scores, np.zeros(0, bool))
    planes = labels[None] == np.array(ids, dtype=labels.dtype)[:, None, None]
    return Instances(
        planes,
        boxes_of(planes),
        tuple(masks.class_names[number] for number in ids),
        np.ones(len(ids), np.float32),
        np.array([number in masks.moving for number in ids], dtype=bool),
    )


class OracleSegmenter:
    """Hands out a sequence's exact masks: every object, with the flag whether it moves.

    Args:
        source: The sequence's masks.
        motion: Whether to say what moves; without, objects count by their class alone, as a perfect network has them.
    """

    def __init__(self, source: MaskSource, *, motion: bool = True) -> None:
        self.source = source
        self.motion = motion

    def segment(self, frame: Frame) -> Instances:
        """The objects of frame `frame.index`.

        Raises:
            SegmentationError: The masks do not have the frame's size, or the sequence has none for this frame, or they
                cannot be read.
        """
        try:
            masks = self.source[frame.index]
        except (IndexError, KeyError) as error:
            raise SegmentationError(f"there are no exact masks for frame {frame.index}") from error
        except MemoryError:
            raise
        except Exception as error:  # the masks of a data set of the user's may raise anything
            raise SegmentationError(f"the exact masks of frame {frame.index} cannot be read: {error}") from error
        check_mask_shape(np.asarray(masks.instances), frame.rgb.shape, f"exact masks of frame {frame.index}")
        found = instances_of(masks, where=f"exact masks of frame {frame.index}")
        return found if self.motion else replace(found, moving=None)
