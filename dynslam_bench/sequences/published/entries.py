"""The public sequences: what the catalogue's data files say of each."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from dynslam_bench.core.settings import Settings, build
from dynslam_bench.core.toml import read_toml
from dynslam_bench.geometry.camera import Camera

from .cameras import CAMERAS

Tag = Literal["static", "low-dynamic", "high-dynamic"]
Split = Literal["tune", "held-out", ""]
_FILES = ("tum.toml", "bonn.toml")


class CatalogueEntry(Settings):
    """One public sequence.

    A number or checksum that is not known is None, never a guess.
    """

    id: str = Field(description="for example tum/fr3/walking_xyz")
    folder: str = Field(description="published folder name, an alias of the id")
    camera: str = Field(description="name of the camera, see dynslam_bench.sequences.published.cameras")
    url: str = Field(description="archive")
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
        """First part of the id, ``tum`` or ``bonn``."""
        return self.id.partition("/")[0]

    def folders(self, data_root: Path) -> tuple[Path, ...]:
        """Where the sequence may lie below a data root, the place `fetch` puts it first."""
        inside = data_root / self.dataset
        places = (inside / self.folder, data_root / self.folder, data_root / self.id)
        return (*places, data_root / self.folder.removeprefix("rgbd_")) if data_root.name == self.dataset else places

    def find(self, data_root: Path) -> Path | None:
        """The folder in which the sequence lies, None if it does not."""
        for folder in self.folders(data_root):
            if (folder / "rgb.txt").is_file():
                return folder
        return None

    def size_text(self) -> str:
        """The archive's size for people."""
        if self.size_bytes is not None:
            return f"{self.size_bytes / 1e9:.2f} GB"
        return self.size_stated or "size unknown"

    def intrinsics(self) -> Camera:
        """The camera."""
        return CAMERAS[self.camera]


@cache
def catalogue() -> dict[str, CatalogueEntry]:
    """All public sequences by id, in the order of the data files."""
    entries: dict[str, CatalogueEntry] = {}
    for name in _FILES:
        document = read_toml(Path(__file__).parent / name)
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
    """All public sequences by their published folder name."""
    return {entry.folder: entry for entry in catalogue().values()}
