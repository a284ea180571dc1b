"""What a reader of recorded sequences finds in a folder; all readers give this, one class makes a sequence of it."""

from __future__ import annotations

from dataclasses import dataclass

from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory

from .lists import ImageList


@dataclass(frozen=True, eq=False)
class Contents:
    """Images and poses of a folder, whatever its layout.

    Attributes:
        colour: Colour images and their stamps in seconds.
        depth: Depth images, registered to the colour images, and their stamps.
        paired: Whether the two lists are paired already, entry by entry; otherwise they are associated by time.
        truth: Camera-to-world poses; None if there are none.
        truth_dropped: One phrase on the poses that were not taken as they stand; empty for none.
        camera: Intrinsics that the folder states; None where it does not.
        fps: Nominal frame rate in Hz that the folder or the layout states; None where neither does.
        missing_depth: Raw value beside 0 that stands for a missing depth; None for none.
        furthest_m: Depth beyond this, in metres, is no measurement (a rendered sky); None for no limit.
    """

    colour: ImageList
    depth: ImageList
    paired: bool = False
    truth: Trajectory | None = None
    truth_dropped: str = ""
    camera: Camera | None = None
    fps: float | None = None
    missing_depth: int | None = None
    furthest_m: float | None = None
