"""Readers of trajectories and maps in the formats of other tools and in our own, and of an export's provenance."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from dynslam_bench.contracts.tracker import MapOutputs
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.runs.exchange import formats
from dynslam_bench.runs.exchange import transfer as provenance
from dynslam_bench.runs.exchange.transfer import PROVENANCE_FILE, Provenance
from dynslam_bench.runs.record import RunRecord
from dynslam_bench.slam import map_files
from dynslam_bench.slam.atlas import open_atlas, packed
from dynslam_bench.slam.map_files import HEADER, MapFeatures, MapHeader, described

from .campaign import Target, at, written
from .mutate import mutate_zip

EUROC = (formats.EUROC_HEADING + "\n1000000000,0,0,0,1,0,0,0\n2000000000,1,2,3,0.5,0.5,0.5,0.5\n").encode()
VSLAM_LAB = b"ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw\n1000000000,0,0,0,0,0,0,1\n2e9,1,2,3,0.6,0,0,0.8\n"
IMAGES = (
    b"# a comment\n1 1 0 0 0 0 0 0 1 rgb/1.5.png\n\n2 0.8 0 0 0.6 1 2 3 1 rgb/2.5.png\n3.0 4.0 -1 5 6 7\n"
    b"3 1 0 0 0 4 5 6 1 c.png\n\n"
)
RGB = b"1.5 rgb/1.5.png\n2.5 rgb/2.5.png\n3.5 c.png\n"


def _read_colmap(data: bytes | None, folder: Path) -> None:
    """With the stamps in the names, or in a list: a part of the inputs each."""
    at(folder, formats.IMAGES, data)
    stamps = at(folder, "rgb.txt", RGB) if len(data or b"") % 2 == 0 else None
    formats.read_trajectory(folder, stamps)


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


CAMERA = Camera(16, 12, 20.0, 20.0, 8.0, 6.0)
FEATURES = MapFeatures(extractor="orb", levels=8, scale_factor=1.2)


def _sound_map() -> dict[str, Any]:
    """Two keyframes of three and two features, two points that both see, a submap."""
    header = MapHeader(
        sensors="rgbd", camera=described(CAMERA), features=FEATURES, next_keyframe=4, next_point=9, made_by="nobody"
    )
    return {
        HEADER: np.frombuffer(header.to_json().encode(), np.uint8),
        "kf_id": np.array([0, 2]), "kf_map": np.array([0, 1]), "kf_pose": np.tile(np.eye(4), (2, 1, 1)),
        "kf_count": np.array([3, 2]), "kf_raw": np.full((5, 2), 4.0, np.float32), "kf_response": np.ones(5, np.float32),
        "kf_xy": np.full((5, 2), 4.0), "kf_right": np.array([1.0, np.nan, 1.0, 1.0, 1.0]),
        "kf_z": np.array([1, 0, 1, 1, 1], np.float32), "kf_octave": np.array([0, 1, 2, 7, 0], np.int8),
        "kf_angle": np.zeros(5, np.float32), "kf_info": np.ones(5), "kf_info_right": np.ones(5),
        "kf_words": np.zeros((5, 4), np.uint64),
        "id": np.array([3, 8]), "position": np.array([[0.0, 0, 1], [0.1, 0, 1]]), "normal": np.eye(3)[[2, 2]],
        "far": np.ones(2), "words": np.zeros((2, 4), np.uint64), "rgb": np.zeros((2, 3), np.uint8),
        "visible": np.ones(2, np.int32), "found": np.ones(2, np.int32), "born": np.array([0, 1]),
        "n_obs": np.array([2, 2], np.int32), "obs_kf": np.array([0, 1, 0, 1], np.int32),
        "obs_ft": np.array([2, 0, 0, 1], np.int32), "submap_start": np.zeros((1, 3)),
        "submap_anchor": np.zeros((1, 3)), "submap_bound": np.array([np.inf]),
    }  # fmt: skip


def _map_seeds() -> list[bytes]:
    """A sound map, and one for every kind of fault."""
    sound = _sound_map()
    far = {"kf_count": np.array([2**60, 2]), "kf_right": np.ones(5), "kf_pose": 2 * np.ones((2, 4, 4))}
    odd: list[dict[str, Any]] = [{}, *({name: value} for name, value in far.items())]
    odd += [{"far": np.zeros(2)}, {"id": np.array([3, 3])}, {"kf_id": np.array([0, 9])}, {"rgb": np.zeros((2, 4))}]
    odd += [{"obs_ft": np.array([2, 2, 0, 1], np.int32)}, {"obs_ft": np.array([2, 1, 0, 0], np.int32)}]
    odd += [{"n_obs": np.array([1, 1], np.int32)}]
    odd += [{"visible": np.zeros(2, np.int32)}, {"position": np.full((2, 3), np.nan)}, {"more": np.zeros(1)}]
    odd += [{HEADER: np.array([255], np.uint8)}, {HEADER: np.frombuffer(b"{}", np.uint8)}]
    nothing = {name: value[:0] for name, value in sound.items() if name != HEADER}
    return [_npz(sound | each) for each in (*odd, nothing)] + [_npz({"header ": np.zeros(1)})]


def _npz(arrays: dict[str, Any]) -> bytes:
    return written(lambda file: np.savez(file, **arrays))


def _read_map(data: bytes | None, folder: Path) -> None:
    """What is read is worked on as a run does, whose compiled loops check no index."""
    atlas = open_atlas(str(at(folder, "map.npz", data)), CAMERA, FEATURES, depth=True)
    world = atlas.world
    world.refresh(world.points)
    for slot in world.keyframes.tolist():
        world.covisible(slot)
        world.project(world.kf_pose[slot], world.points)
    packed(atlas)
    world.remove_keyframe(int(world.keyframes[0]))


TARGETS = [
    Target(
        "table of poses",
        lambda data, folder: formats.read_trajectory(at(folder, "data.csv", data)),
        lambda: [EUROC, VSLAM_LAB],
    ),
    Target("COLMAP images", _read_colmap, lambda: [IMAGES, IMAGES + b"\n"]),
    Target("map of points", lambda data, folder: map_files.read_ply(at(folder, "map.ply", data)), _maps),
    Target("provenance of an export", _read_provenance, _provenances),
    Target("map of a run", _read_map, _map_seeds, mutate_zip),
]
