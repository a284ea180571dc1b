"""Blackouts and kidnapped cameras in rendered scenes: after how many frames the camera is relocalised.

    python tests/benchmarks/lost_and_found.py

Frames are rendered and their ORB features kept, those on people left out by the exact masks; the
back end of `orb-slam2` is driven over them again and again, each time from another start. A case is
one of:

* black: 100 frames, 20 frames without any feature while the camera moves on, 30 frames;
* kidnapped: 200 frames, then 30 frames of what was seen 150 frames ago, from one frame to the next;
* carried: the same with 20 frames in between.

The view afterwards is known if an earlier frame that was tracked was taken within 0.3 m and 20
degrees of it. Bar: of the known ones all are `ok` within ten frames. A frame that is `ok` is wrong
if its camera centre is farther than 0.1 m from the true one in the world of the first frame, beyond
what it was before the loss; a black one always is.
"""

import one_thread  # noqa: F401  # before all others

# isort: split
from dataclasses import dataclass

import cv2
import numpy as np
import pandas as pd

from dynslam_bench.contracts import FrameBundle, Keypoints
from dynslam_bench.features.registry import build_extractor
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.geometry import Camera, se3
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.sequences import open_sequence
from dynslam_bench.slam.backend import Backend
from dynslam_bench.slam.settings import BackendSettings

SCENES = [
    *(f"synthetic/sitting_{motion}?scene=103" for motion in ("xyz", "halfsphere", "rpy")),
    "synthetic/walking_halfsphere?scene=103",
    "synthetic/loop_room?scene=103&frames=1800",
]
BEFORE = {"black": 100, "kidnapped": 200, "carried": 200}
BACK = 150
AFTER = 30
SOON = 10
FRAMES = 300
BLACK = 20
CASES = 6
"""Frames of a scene, black ones of a case, cases of a kind in a scene."""
NEAR_M = 0.3
NEAR_DEG = 20.0
WRONG_M = 0.1
DILATION = 15
"""Pixels around people that count as theirs."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A rendered scene.

    Attributes:
        camera: The camera.
        frames: Static keypoints of each frame, their depth, and the mask of people as packed bits.
        poses: True camera-to-world poses ``[N, 4, 4]``.
        fps: Frames a second.
    """

    camera: Camera
    frames: list[tuple[Keypoints, np.ndarray, np.ndarray]]
    poses: np.ndarray
    fps: float


def rendered(source: str) -> Scene:
    """Features of the first `FRAMES` frames of a sequence; of every second one where the camera walks."""
    stride = 2 if "loop" in source else 1
    sequence = open_sequence(source, frames=(0, FRAMES * stride), stride=stride)
    extractor = build_extractor(FeatureSettings())
    kernel = np.ones((2 * DILATION + 1, 2 * DILATION + 1), np.uint8)
    frames = []
    for index in range(len(sequence)):
        frame = sequence[index]
        masks = sequence.masks[index]
        people = np.isin(
            masks.instances, [n for n, name in masks.class_names.items() if name == "person"]
        )
        mask = cv2.dilate(people.astype(np.uint8), kernel) > 0
        keypoints = extractor.extract_masked(
            cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), mask, SegmentationSettings().outside_share
        )
        column, row = np.rint(keypoints.xy).astype(int).T
        at = row.clip(0, mask.shape[0] - 1), column.clip(0, mask.shape[1] - 1)
        static = np.flatnonzero(~mask[at])
        frames.append(
            (keypoints.select(static), frame.depth[at][static].clip(min=0), np.packbits(mask))
        )
    stamps = sequence.timestamps
    truth = sequence.ground_truth
    nearest = np.abs(truth.timestamps[:, None] - stamps[None]).argmin(axis=0)
    return Scene(sequence.camera, frames, truth.T_world_cam[nearest], sequence.fps / stride)


def frame_of(scene: Scene, index: int | None, number: int) -> FrameBundle:
    """A frame of the case; None is a black one."""
    size = scene.camera.height, scene.camera.width
    keypoints, z, packed = scene.frames[index or 0]
    mask = np.unpackbits(packed).reshape(size).astype(bool)
    if index is None:
        keypoints = keypoints.select(np.zeros(0, np.int64))
        z = z[:0]
        mask = np.zeros(size, bool)
    blank = np.zeros((*size, 3), np.uint8)
    pictures = blank, blank[..., 0], np.zeros(size, np.float32)
    return FrameBundle(
        number,
        number / scene.fps,
        *pictures,
        keypoints,
        keypoints.xy.astype(np.float64),
        z,
        mask=mask,
    )


def path_of(kind: str, start: int) -> list[int | None]:
    """Which frames a case shows, in order."""
    left = start + BEFORE[kind]
    back = left + BLACK if kind == "black" else left - BACK
    return [
        *range(start, left),
        *[None] * (0 if kind == "kidnapped" else BLACK),
        *range(back, back + AFTER),
    ]


def is_known(scene: Scene, view: int, mapped: list[int]) -> bool:
    """Whether the camera was near a view before."""
    relative = se3.inverse(scene.poses[view]) @ scene.poses[mapped]
    near = np.linalg.norm(relative[:, :3, 3], axis=1) <= NEAR_M
    rotated = np.degrees(
        np.arccos(np.clip((np.trace(relative[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
    )
    return bool((near & (rotated <= NEAR_DEG)).any())


def case(scene: Scene, kind: str, start: int) -> dict[str, object]:
    """Drive one case; a row of the table of cases."""
    path = path_of(kind, start)
    before = BEFORE[kind]
    backend = Backend(BackendSettings())
    backend.reset(scene.camera, 0)
    ok = np.zeros(len(path), bool)
    error = np.zeros(len(path))
    for number, index in enumerate(path):
        frame = frame_of(scene, index, number)
        result = backend.track(frame, np.ones(len(frame), bool), np.ones(len(frame), np.float32))
        ok[number] = result.state == "ok"
        if ok[number] and index is not None:
            true = (se3.inverse(scene.poses[start]) @ scene.poses[index])[:3, 3]
            error[number] = np.linalg.norm(result.T_world_cam[:3, 3] - true)
    dark = np.array([index is None for index in path])
    again = np.flatnonzero(ok[-AFTER:])
    mapped = [path[number] for number in np.flatnonzero(ok[:before])]
    return {
        "known": bool(mapped) and is_known(scene, path[-AFTER], mapped),
        "frames_lost": int(again[0]) + 1 if len(again) else np.inf,
        "wrong": np.count_nonzero(ok & (dark | (error > error[:before].max() + WRONG_M))),
        "worst_mm": 1e3 * error[ok].max(initial=0),
    }


def row(name: str, cases: pd.DataFrame) -> str:
    """One row of the printed table."""
    known = cases[cases.known].frames_lost
    found = known[np.isfinite(known)]
    cells = (len(cases), len(known), (known <= SOON).sum(), found.median(), found.max(), cases.wrong.sum(),
             cases.worst_mm.max())  # fmt: skip
    return f"| {name} | {' | '.join(f'{cell:.0f}' for cell in cells)} |"


def main() -> None:
    """Print a row for each kind of loss."""
    cv2.setNumThreads(1)
    rows = []
    for scene in map(rendered, SCENES):
        for kind in BEFORE:
            length = max(index for index in path_of(kind, 0) if index is not None) + 1
            starts = np.linspace(0, FRAMES - length, CASES).astype(int).tolist()
            rows += [{"loss": kind} | case(scene, kind, start) for start in starts]
    cases = pd.DataFrame(rows)
    head = ("loss", "cases", "known views", "relocalised within ten frames", "median frames", "most frames",
            "wrong poses", "largest error mm")  # fmt: skip
    print(f"| {' | '.join(head)} |\n| ---{' | ---:' * (len(head) - 1)} |")
    for kind, part in cases.groupby("loss", sort=False):
        print(row(str(kind), part))
    print(row("all", cases))


if __name__ == "__main__":
    main()
