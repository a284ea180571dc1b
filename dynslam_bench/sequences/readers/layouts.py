"""Every layout of recorded sequences that is read, and which one a folder has.

A new reader is a module beside this one with ``read(folder, fps) -> Contents``, and a row of `LAYOUTS`
(``docs/how-to/dataset.md``).
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.sequences.readers.lists import Contents


@dataclass(frozen=True)
class Layout:
    """One layout.

    Attributes:
        name: For example ``7-scenes``; the catalogue names it.
        module: Module of the reader, beside this one; its ``read(folder, fps)`` gives `Contents`.
        marks: A folder has this layout if all of these files are in it (patterns), or in its folder ``mav0``.
    """

    name: str
    module: str
    marks: tuple[str, ...]

    def fits(self, folder: Path) -> bool:
        """Whether a folder has this layout."""
        return any(all(any(base.glob(mark)) for mark in self.marks) for base in (folder, folder / "mav0"))

    def read(self, folder: Path, fps: float | None = None) -> Contents:
        """What a folder of this layout holds.

        Args:
            folder: The sequence's folder.
            fps: Nominal frame rate in Hz, where the user or the catalogue states one.

        Raises:
            SequenceError: It is not in this layout, or damaged.
            TrajectoryError: Its ground truth cannot be read.
        """
        if not folder.is_dir():
            raise SequenceError(f"there is no sequence folder {folder}")
        return cast("Contents", importlib.import_module(f"{__package__}.{self.module}").read(folder, fps))


TUM = Layout("tum", "tum", ("rgb.txt",))
LAYOUTS = (
    Layout("eth3d", "eth3d", ("calibration.txt", "associated.txt")),
    Layout("icl-nuim", "icl_nuim", ("*.gt.freiburg",)),
    Layout("7-scenes", "seven_scenes", ("frame-*.color.png",)),
    Layout("tartanair-shibuya", "tartanair_shibuya", ("gt_pose.txt", "times.txt")),
    Layout("openloris", "openloris", ("color.txt", "aligned_depth.txt")),
    Layout("vslam-lab", "vslam_lab", ("rgb.csv", "calibration.yaml")),
    Layout("euroc", "euroc", ("cam0/data.csv",)),
    TUM,
)


def find_layout(folder: Path) -> Layout:
    """The layout of a folder; TUM's where no other fits."""
    return next((layout for layout in LAYOUTS if layout.fits(folder)), TUM)


def layout_of(name: str) -> Layout:
    """A layout by name.

    Raises:
        SequenceError: There is none of that name.
    """
    for layout in LAYOUTS:
        if layout.name == name:
            return layout
    raise SequenceError(f"unknown layout '{name}'", f"one of {', '.join(layout.name for layout in LAYOUTS)}")


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag, rather than a folder of images."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() and any([*path.glob("*.db3"), *path.glob("*.mcap")])
    return path.is_file() and path.suffix in (".bag", ".mcap", ".db3")
