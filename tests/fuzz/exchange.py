"""Readers of trajectories and maps in the formats of other tools, and of what an export says of itself."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from dynslam_bench.contracts.tracker import MapOutputs
from dynslam_bench.runs.exchange import formats as colmap
from dynslam_bench.runs.exchange import formats as pose_tables
from dynslam_bench.runs.exchange import formats as reading
from dynslam_bench.runs.exchange import transfer as provenance
from dynslam_bench.runs.exchange.transfer import PROVENANCE_FILE, Provenance
from dynslam_bench.runs.record import RunRecord
from dynslam_bench.slam import map_files

from .target import Target, at

EUROC = (pose_tables.EUROC_HEADING + "\n1000000000,0,0,0,1,0,0,0\n2000000000,1,2,3,0.5,0.5,0.5,0.5\n").encode()
VSLAM_LAB = b"ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw\n1000000000,0,0,0,0,0,0,1\n2e9,1,2,3,0.6,0,0,0.8\n"
IMAGES = (
    b"# a comment\n1 1 0 0 0 0 0 0 1 rgb/1.5.png\n\n2 0.8 0 0 0.6 1 2 3 1 rgb/2.5.png\n3.0 4.0 -1 5 6 7\n"
    b"3 1 0 0 0 4 5 6 1 c.png\n\n"
)
RGB = b"1.5 rgb/1.5.png\n2.5 rgb/2.5.png\n3.5 c.png\n"


def _read_colmap(data: bytes | None, folder: Path) -> None:
    """With the stamps in the names, or in a list: a part of the inputs each."""
    at(folder, colmap.IMAGES, data)
    stamps = at(folder, "rgb.txt", RGB) if len(data or b"") % 2 == 0 else None
    reading.read_trajectory(folder, stamps)


def _read_provenance(data: bytes | None, folder: Path) -> None:
    """Asked of the file and of its folder; whatever it says, no other file is looked at, and nothing is raised."""
    at(folder, PROVENANCE_FILE, data)
    file = at(folder, "trajectory.txt", b"# none\n")
    assert [asked for asked in (file, folder) if not isinstance(provenance.stated_provenance(asked), str)] == []


def _provenances() -> list[bytes]:
    digest = provenance.digest_of(Path(__file__))
    record = RunRecord.read(Path(__file__).parents[1] / "runs" / "data" / "run.json")
    shared = {"format": "tum", "which": "final", "run": record}
    files = ({"trajectory.txt": digest}, {"../x": digest}, {"a\x00b": digest}, {})
    return [Provenance(files=each, **shared).to_json().encode() for each in files]


def _maps() -> list[bytes]:
    with tempfile.TemporaryDirectory() as made:
        path = Path(made) / "map.ply"
        rng = np.random.default_rng(0)
        outputs = MapOutputs((), np.arange(4), rng.normal(size=(4, 3)), np.zeros((4, 3), np.uint8), np.arange(4))
        map_files.write_ply(path, outputs)
        return [path.read_bytes()]


TARGETS = [
    Target(
        "table of poses",
        lambda data, folder: reading.read_trajectory(at(folder, "data.csv", data)),
        lambda: [EUROC, VSLAM_LAB],
    ),
    Target("COLMAP images", _read_colmap, lambda: [IMAGES, IMAGES + b"\n"]),
    Target("map of points", lambda data, folder: map_files.read_ply(at(folder, "map.ply", data)), _maps),
    Target("provenance of an export", _read_provenance, _provenances),
]
