"""The public sequences: what the catalogue's data files say of each."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from dynslam_bench.core.settings import Settings, build
from dynslam_bench.core.toml import read_toml
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.sequences.cameras import CAMERAS
from dynslam_bench.sequences.readers.layouts import layout_of

Tag = Literal["static", "low-dynamic", "high-dynamic"]
Split = Literal["tune", "held-out", ""]
_FILES = ("tum", "bonn", "wild_slam", "eth3d", "icl", "seven_scenes", "shibuya", "openloris")


class CatalogueEntry(Settings):
    """One public sequence.

    A number or checksum that is not known is None, never a guess.
    """

    id: str = Field(description="for example tum/fr3/walking_xyz")
    folder: str = Field(description="published folder name, an alias of the id")
    camera: str = Field(default="", description="name of the camera; empty where the folder or the layout states it")
    layout: str = Field(default="tum", description="name of the layout, see dynslam_bench.sequences.readers.layouts")
    url: str = Field(description="archive")
    verified: bool = Field(default=False, description="whether the publisher's own files were read with it")
    more_urls: tuple[str, ...] = Field(default=(), description="further archives that belong to the same folder")
    by_hand: str = Field(default="", description="why this program cannot fetch it; empty where it can")
    distinctive: bool = Field(default=True, description="whether the folder's name alone tells which sequence it is")
    title: str = Field(description="name of the data set")
    page: str = Field(default="", description="web page of the data set")
    size_bytes: int | None = Field(default=None, description="exact size of the archive")
    size_stated: str = Field(default="", description="size as the data set's page states it")
    sha256: str | None = Field(default=None, pattern=r"^[0-9a-f]{64}$", description="checksum of the archive")
    license: str = Field(description="licence of the data")
    citation: str = Field(description="what to cite")
    ground_truth: bool = Field(default=True, description="whether the ground truth is public")
    tags: tuple[Tag, ...] = Field(default=(), description="how much of the scene moves")
    split: Split = Field(default="", description="whether studies may tune on it")
    fps: float = Field(default=30.0, gt=0, description="nominal frame rate in Hz")
    remark: str = Field(default="", description="anything else worth knowing")

    @property
    def dataset(self) -> str:
        """First part of the id, ``tum`` for example."""
        return self.id.partition("/")[0]

    def folders(self, data_root: Path) -> tuple[Path, ...]:
        """Where the sequence may lie below a data root, the place `fetch` puts it first."""
        inside = data_root / self.dataset
        if not self.distinctive:
            return inside / self.folder, data_root / self.id
        places = (inside / self.folder, data_root / self.folder, data_root / self.id)
        return (*places, data_root / self.folder.removeprefix("rgbd_")) if data_root.name == self.dataset else places

    def find(self, data_root: Path) -> Path | None:
        """The folder in which the sequence lies, None if it does not."""
        layout = layout_of(self.layout)
        return next((folder for folder in self.folders(data_root) if layout.fits(folder)), None)

    def how_to_get(self) -> str:
        """What a user does to have it, for the end of a message."""
        if self.by_hand:
            return f"get it by hand from {self.page} ({self.by_hand}) and put it there"
        return f"fetch it with: dynslam-bench sequences fetch {self.id}"

    def size_text(self) -> str:
        """The archive's size for people."""
        if self.size_bytes is not None:
            return f"{self.size_bytes / 1e9:.2f} GB"
        return self.size_stated or "size unknown"

    def intrinsics(self) -> Camera | None:
        """The camera; None where only the sequence's own files state it."""
        return CAMERAS[self.camera] if self.camera else None


@cache
def catalogue() -> dict[str, CatalogueEntry]:
    """All public sequences by id, in the order of the data files."""
    entries: dict[str, CatalogueEntry] = {}
    for name in _FILES:
        document = read_toml(Path(__file__).parent / f"{name}.toml")
        common: dict[str, Any] = document["common"]
        for row in document["sequence"]:
            entry = build(CatalogueEntry, {**common, **row})
            entries[entry.id] = entry
    return entries


def entry_of(name: str) -> CatalogueEntry | None:
    """The catalogue's entry of an id or published folder name, None if there is none."""
    entries = catalogue()
    return entries.get(name) or by_folder().get(name)


@cache
def by_folder() -> dict[str, CatalogueEntry]:
    """The public sequences whose published folder name is like no other, by that name."""
    return {entry.folder: entry for entry in catalogue().values() if entry.distinctive}


@cache
def public_datasets() -> dict[str, CatalogueEntry]:
    """The public data sets by name, each with its first sequence, in the order of the data files."""
    first: dict[str, CatalogueEntry] = {}
    for entry in catalogue().values():
        first.setdefault(entry.dataset, entry)
    return first
