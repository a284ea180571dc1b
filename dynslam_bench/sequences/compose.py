"""Composites: people of a recording by a fixed camera, pasted in depth order into a recording that has a truth.

The person is cut out where depth is nearer than the background, which the fixed camera sees
uncovered in other frames, and moved as a whole to a place before the host's camera. It is drawn
from the host's true poses, so that it stands in the host's world, hides what is behind it, is
hidden by what is before it, and casts the depth camera's shadow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from dynslam_bench.contracts import Frame, Sequence
from dynslam_bench.core import SequenceError, atomic_folder, write_atomic
from dynslam_bench.geometry import Array, Camera, Trajectory, se3, write_tum
from dynslam_bench.sequences.cameras import camera_by_name, write_camera
from dynslam_bench.sequences.readers.layouts import PEOPLE_LIST

# How a person is cut out.
_NEARER_M = 0.08
"""A pixel shows a person if its depth is less than the background's by this and by `_NEARER_SHARE` of it."""
_NEARER_SHARE = 0.04
"""See `_NEARER_M`."""
_BACKGROUND_FRAMES = 150
"""Frames that tell the background's depth, at most."""
_BLOCKS = 16
"""Parts of the image whose background is computed one by one."""
_LEAST_PX = 0.01
"""Smallest share of the image that a person fills; less is noise, or a person who has just begun to enter."""
_BORDER_PX = 2
"""A person who reaches the left, right or upper border so closely is partly outside."""
_SQUARE = np.ones((3, 3), np.uint8)
"""Neighbourhood for specks, and for edges of depth."""
_DISC = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
"""Neighbourhood for holes, and for the uncertain band along an outline."""
_LEAST_DISC = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))
"""Smallest disc of a person that is kept: smaller ones are points that were drawn without neighbours."""
_SHIFT_PX = 1.5
"""Images of a fixed camera shift by less against each other, by the median."""

# Where a person is placed.
_MOST_PEOPLE = 3
"""People in a composite, at most."""
_PLACES = 12
"""Places that are tried."""
_SAMPLED = 6
"""Frames on which each place is tried."""
_REDUCED = 4
"""Factor by which the images of these frames are reduced."""
_DISTANCES_M = 0.8, 1.5
"""Distance of the person in the host's first image, metres."""
_SCALES = 1.0, 0.75, 0.6, 0.45
"""Sizes that are tried, with the distance in proportion."""
_SHARES = 0.1, 0.35
"""Share of the image that the person fills on average."""
_GAP_M = 0.05
"""A person less than this before a surface is taken to stand in it."""
_NEAREST_M = 0.5
"""Nearer surfaces are not measured by a Kinect, and too little is known of the person to draw them."""
_GAP_S = 0.1
"""A frame may lie so far beyond the host's first and last true pose, and has that pose then."""

# How a person is drawn.
_UPSAMPLED = 4
"""Factor by which a cutout's resolution is increased before its points are drawn."""
_EDGE_M = 0.1
"""Neighbouring pixels of a person whose depths differ by more are parts of the body before each other."""
_SHADOW_BASELINE_M = 0.075
"""Distance between a Kinect's projector and its infrared camera."""
_FURTHEST_SHADOW_PX = 80
"""Widest shadow that is drawn."""
_IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
"""The poses that are written are the camera's, whatever body the host's data set tracks."""
_LISTS = {"rgb": "rgb.txt", "depth": "depth.txt", "people": PEOPLE_LIST}
"""Folder and list of each kind of image that is written."""

Cutout = tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.bool_]]
"""A person in one frame: colours ``[H, W, 3]``, the person's depth in metres ``[H, W]`` and mask ``[H, W]``."""


@dataclass(frozen=True)
class Composed:
    """The result of `compose`.

    Attributes:
        folder: The sequence, in TUM layout with ``people.txt``.
        frames: Number of frames.
        share: Mean share of the pixels that show the person, 0 to 1.
        largest_share: The largest share of a frame.
    """

    folder: Path
    frames: int
    share: float
    largest_share: float


def compose(
    host: Sequence,
    people: Sequence,
    folder: str | Path,
    instance: int = 0,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Composed:
    """Paste the people of one recording into another one, and write the result as a folder in TUM layout.

    Args:
        host: A recording with depth and ground truth; its colour, depth and poses are kept.
        people: A recording by a camera that does not move.
        folder: The folder to make.
        instance: Which placement: one to three people, each with a distance, side, turn, mirroring
            and first frame that are drawn from it.
        progress: Called with frames done and frames in all.

    Raises:
        SequenceError: The folder exists, the host has people or no ground truth of all frames, the
            people's camera moves, or nobody is seen.
        DynslamError: A frame cannot be read, or the folder not be written.
    """
    target = Path(folder).expanduser().absolute()
    truth = _checked_truth(host, target)
    _check_fixed(people)

    # Cut the people out, and draw a place for each.
    cutouts = Cutouts(people)
    rng = np.random.default_rng(instance)
    T_world_cam = _poses(truth, host.timestamps)
    actors = [
        _Actor(cutouts, people.fps, host, T_world_cam, rng)
        for _ in range(1 + instance % _MOST_PEOPLE)
    ]

    # Draw them into every frame, and write the sequence.
    shares = []
    with atomic_folder(target) as work:
        for kind, listed in _LISTS.items():
            (work / kind).mkdir()
            lines = [f"{stamp:.6f} {kind}/{stamp:.6f}.png\n" for stamp in host.timestamps.tolist()]
            write_atomic(work / listed, "".join(lines))
        for i in range(len(host)):
            drawn = [actor.draw(i, host.camera) for actor in actors]
            shares.append(_write_frame(host[i], host.camera, drawn, cutouts.tone, work))
            progress(i + 1, len(host))
        write_tum(work / "groundtruth.txt", truth, comment=f"of {host.id}")
        _write_camera(host, target, work)
        if not max(shares):
            raise SequenceError(
                f"nobody can be seen in '{host.id}': all of its depth is missing or nearer than people"
            )
    return Composed(target, len(host), float(np.mean(shares)), float(np.max(shares)))


def _checked_truth(host: Sequence, target: Path) -> Trajectory:
    """The truth of a host that people can be pasted into; refuse one without truth or with people."""
    truth = host.ground_truth
    if truth is None:
        raise SequenceError(
            f"'{host.id}' has no ground truth, so nobody can be placed in its world"
        )
    if target.exists():
        raise SequenceError(f"{target} exists already", "name a folder that does not")
    if host.masks is not None:
        raise SequenceError(
            f"'{host.id}' has people already", "compose the recording that was its host"
        )
    # every frame needs a pose, by which people are placed in its world
    begin = truth.timestamps[0] - _GAP_S
    end = truth.timestamps[-1] + _GAP_S
    outside = int(np.count_nonzero((host.timestamps < begin) | (host.timestamps > end)))
    if outside or len(truth) < 2:
        raise SequenceError(
            f"{outside} of {len(host)} frames of '{host.id}' lie outside its ground truth's time"
        )
    return truth


def _check_fixed(people: Sequence) -> None:
    """Refuse people of a camera that moves, by its truth, else by the shift of its images against the first one."""
    cure = "people are cut out of recordings by a fixed camera"
    truth = people.ground_truth
    if truth is not None and len(truth) > 1 and not se3.is_static(truth.T_world_cam):
        raise SequenceError(f"the camera of '{people.id}' moves", cure)
    # without a truth: shifts of a few images against the first one, by phase correlation
    sampled = np.linspace(0, len(people) - 1, _SAMPLED).astype(int).tolist()
    first, *others = (
        cv2.cvtColor(people[i].rgb, cv2.COLOR_RGB2GRAY).astype(np.float32) for i in sampled
    )
    window = cv2.createHanningWindow(first.shape[::-1], cv2.CV_32F)
    shifts = [np.linalg.norm(cv2.phaseCorrelate(first, other, window)[0]) for other in others]
    shift = np.median(shifts)
    if shift > _SHIFT_PX:
        raise SequenceError(
            f"the camera of '{people.id}' moves: its images shift by {shift:.1f} px", cure
        )


def _write_frame(
    frame: Frame,
    camera: Camera,
    drawn: list[tuple[NDArray[np.float32], NDArray[np.float32]]],
    tone: Array,
    work: Path,
) -> float:
    """Paste drawn people into a frame of the host and write its images.

    Args:
        frame: The frame.
        camera: The host's.
        drawn: Colour and depth of each person, as `_Actor.draw` gives them.
        tone: Mean colour of the people's recording.
        work: The folder of the sequence.

    Returns:
        The share of the image that shows people.
    """
    # Colours of the people as under the host's light.
    gain = np.clip(frame.rgb.reshape(-1, 3).mean(axis=0) / tone, 0.4, 1.6)
    colour, z, ids = _nearest(drawn)
    rgb, depth, shown = paste(frame.rgb, frame.depth, colour * gain.astype(np.float32), z, camera)

    raw = np.rint(depth * camera.written_depth_factor).clip(0, 65535).astype(np.uint16)
    images = (rgb[..., ::-1], raw, np.where(shown, ids, 0).astype(np.uint8))
    for kind, image in zip(_LISTS, images, strict=True):
        data = cv2.imencode(".png", image)[1].tobytes()
        write_atomic(work / kind / f"{frame.timestamp:.6f}.png", data)
    return float(shown.mean())


def _write_camera(host: Sequence, target: Path, work: Path) -> None:
    """Write the host's camera; its poses are the camera's, even where the folder's name says another body."""
    camera = replace(host.camera, depth_factor=host.camera.written_depth_factor)
    if host.camera.R_body_cam is not None or camera_by_name(target) is not None:
        camera = replace(camera, R_body_cam=_IDENTITY)
    write_camera(work / "camera.toml", camera, fps=host.fps)


class Cutouts:
    """The person in every frame of a fixed camera in which one is seen, in order; images are read when they are drawn.

    Args:
        people: The recording.

    Attributes:
        camera: Its camera.
        tone: Its mean colour ``[3]``.
        centres: Median of the person's points in the camera's frame, metres ``[N, 3]``.

    Raises:
        SequenceError: Nobody is seen.
    """

    def __init__(self, people: Sequence) -> None:
        self._people = people
        self.camera = people.camera
        self._background = _background(people)
        self._masks: list[tuple[int, NDArray[np.uint8]]] = []
        colours = []
        centres = []
        for i in range(len(people)):
            # what is nearer than the background is the person
            frame = people[i]
            colours.append(frame.rgb.reshape(-1, 3).mean(axis=0))
            mask = _person(self._nearer(frame), frame.rgb)

            # someone who is partly outside cannot be pasted whole.
            left = mask[:, :_BORDER_PX].any()
            right = mask[:, -_BORDER_PX:].any()
            above = mask[:_BORDER_PX].any()
            if mask.mean() < _LEAST_PX or left or right or above:
                continue

            # keep the mask, and where the person is: the median of their points
            self._masks.append((i, np.packbits(mask)))
            pixels = self.camera.undistort_points(np.stack(np.nonzero(mask)[::-1], axis=1))
            points = self.camera.unproject(pixels, self._depth(frame, mask)[mask])
            centres.append(np.median(points, axis=0))
        if not centres:
            raise SequenceError(
                f"nobody walks through '{people.id}'", "nothing comes nearer than its background"
            )
        self.tone = np.mean(colours, axis=0)
        self.centres = np.array(centres)
        self.cutout = lru_cache(maxsize=_SAMPLED)(self._cutout)

    def _cutout(self, index: int) -> Cutout:
        """The `index`-th cutout, read from its image."""
        at, packed = self._masks[index]
        frame = self._people[at]
        mask = np.unpackbits(packed, count=frame.depth.size).reshape(frame.depth.shape).astype(bool)
        return frame.rgb, self._depth(frame, mask), mask

    def _nearer(self, frame: Frame) -> NDArray[np.bool_]:
        """Pixels ``[H, W]`` in which a frame is nearer than the background."""
        least = np.maximum(_NEARER_M, _NEARER_SHARE * self._background)
        return np.asarray((frame.depth > 0) & (frame.depth < self._background - least))

    def _depth(self, frame: Frame, mask: NDArray[np.bool_]) -> NDArray[np.float32]:
        """The person's depth ``[H, W]``, without holes."""
        measured = np.where(self._nearer(frame) & mask, frame.depth, 0).astype(np.float32)
        return _smoothed(_filled(measured))


def _background(people: Sequence) -> Array:
    """Depth ``[H, W]``: the median of what is as far as the farthest tenth of a pixel's measurements; 0 without any."""
    count = min(len(people), _BACKGROUND_FRAMES)
    sampled = np.linspace(0, len(people) - 1, count).astype(int).tolist()
    stack = np.stack([people[i].depth for i in sampled])
    blocks = []
    for depths in np.array_split(stack, _BLOCKS, axis=1):
        measured = np.where(depths > 0, depths, np.nan)
        # never measured: nobody is told from what is behind
        measured[:, ~(depths > 0).any(axis=0)] = 0
        # people who stand before the background are nearer than the farthest measurements
        farthest = np.nanquantile(measured, 0.9, axis=0)
        far = np.where(measured >= 0.97 * farthest, measured, np.nan)
        blocks.append(np.nanmedian(far, axis=0))
    return np.concatenate(blocks)


def _person(nearer: NDArray[np.bool_], rgb: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """The largest region that is nearer than the background, its outline moved to the edges of the colour image."""
    # The largest region, without specks and holes.
    opened = cv2.morphologyEx(nearer.astype(np.uint8), cv2.MORPH_OPEN, _SQUARE)
    closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, _DISC, iterations=2)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(closed)
    if len(stats) < 2 or stats[1:, cv2.CC_STAT_AREA].max() < _LEAST_PX * nearer.size:
        return np.zeros_like(nearer)
    region = (labels == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())).astype(np.uint8)
    # GrabCut decides between what is surely the person and what is surely the background.
    trimap = np.full(region.shape, cv2.GC_BGD, np.uint8)
    trimap[cv2.dilate(region, _DISC) > 0] = cv2.GC_PR_BGD
    trimap[region > 0] = cv2.GC_PR_FGD
    trimap[cv2.erode(region, _DISC, iterations=2) > 0] = cv2.GC_FGD
    cv2.setRNGSeed(0)
    models = (np.zeros((1, 65)), np.zeros((1, 65)))
    image = np.ascontiguousarray(rgb[..., ::-1])
    cv2.grabCut(image, trimap, (0, 0, 1, 1), *models, 2, cv2.GC_INIT_WITH_MASK)
    return np.isin(trimap, (cv2.GC_FGD, cv2.GC_PR_FGD))


def _filled(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth everywhere: where it is 0, that of the nearest pixel that has one; 0 where none has."""
    # the number of the nearest measured pixel for each pixel, and that one's depth
    empty = (depth == 0).astype(np.uint8)
    by_pixel = cv2.DIST_LABEL_PIXEL
    _, labels = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 5, labelType=by_pixel)
    values = np.zeros(labels.max() + 1, np.float32)
    values[labels[depth > 0]] = depth[depth > 0]
    return values[labels]


def _smoothed(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """The median of 5x5 pixels."""
    return np.asarray(cv2.medianBlur(depth, 5), dtype=np.float32)


def _poses(truth: Trajectory, stamps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Interpolated poses ``[N, 4, 4]`` at stamps; beyond its ends those of the ends."""
    times = truth.timestamps
    at = np.clip(stamps, times[0], times[-1])
    rotation = Slerp(times, Rotation.from_matrix(truth.T_world_cam[:, :3, :3]))(at).as_matrix()
    places = np.stack([np.interp(at, times, axis) for axis in truth.positions.T], axis=1)
    return se3.from_matrix(places, rotation)


class _Actor:
    """A person at a drawn place in the host's world.

    Args:
        cutouts: The person, frame by frame.
        fps: Frames a second of the recording that they are cut out of.
        host: The recording that the person is drawn into.
        T_world_cam: The host's poses ``[N, 4, 4]``.
        rng: Draws place and time.
    """

    def __init__(
        self,
        cutouts: Cutouts,
        fps: float,
        host: Sequence,
        T_world_cam: Array,
        rng: np.random.Generator,
    ) -> None:
        self.cutouts = cutouts
        self.T_world_cam = T_world_cam
        # The cutouts are played forth and back; the index of each frame lies between two cutouts, too.
        seconds = host.timestamps - host.timestamps[0]
        last = len(cutouts.centres) - 1
        phase = np.mod(rng.uniform(0, last) + fps * seconds, 2 * max(last, 1))
        self.played = np.minimum(phase, np.maximum(2 * last - phase, 0))
        # A turn about the vertical, and perhaps mirrored.
        turn = Rotation.from_rotvec([0, np.deg2rad(rng.uniform(-15, 15)), 0]).as_matrix()
        self.R_start_people = turn @ np.diag([rng.choice([-1.0, 1.0]), 1.0, 1.0])
        self.T_world_people = np.eye(4)
        self._place(host, rng)

    def _place(self, host: Sequence, rng: np.random.Generator) -> None:
        """Choose the best of some drawn places.

        A person is upright in the host's first image and has the size there of one at the drawn
        distance. Where this place lies behind or in the host's surfaces, the person is brought
        nearer and made smaller in proportion.
        """
        # the host's surfaces in a few reduced images
        small = host.camera.resized(host.camera.width // _REDUCED, host.camera.height // _REDUCED)
        sampled = np.linspace(0, len(host) - 1, _SAMPLED).astype(int).tolist()
        surfaces = []
        for i in sampled:
            reduced = host[i].depth[::_REDUCED, ::_REDUCED]
            surfaces.append(_filled(reduced[: small.height, : small.width]))

        # draw places; each is tried at its distance, then nearer and smaller
        centre = np.median(self.cutouts.centres[self.played.astype(int)], axis=0)
        best = self.T_world_people
        least = np.inf
        for _ in range(_PLACES):
            distance_m = rng.uniform(*_DISTANCES_M)
            target = distance_m * np.array([rng.uniform(-0.3, 0.3), rng.uniform(-0.1, 0.2), 1.0])
            for scale in _SCALES:
                shift = scale * (target - self.R_start_people @ centre)
                T_start_people = se3.from_matrix(shift, scale * self.R_start_people)
                self.T_world_people = self.T_world_cam[0] @ T_start_people

                # cost: a wrong share of the image, hidden parts, a size that differs from the real one
                share, hidden = self._visibility(small, sampled, surfaces)
                outside = max(_SHARES[0] - share, share - _SHARES[1], 0.0)
                cost = 10 * outside + hidden / max(share, 1e-3) - 0.05 * scale
                if cost < least:
                    best = self.T_world_people
                    least = cost
        self.T_world_people = best

    def _visibility(
        self, camera: Camera, frames: list[int], surfaces: list[NDArray[np.float32]]
    ) -> tuple[float, float]:
        """Mean share of the image in which the person is seen, and in which they are hidden or too near.

        Args:
            camera: The host's, for images of the surfaces' size.
            frames: Frames of the host.
            surfaces: The host's depth in each, without holes.
        """
        shares = []
        hidden = []
        for i, depth in zip(frames, surfaces, strict=True):
            _, z = self.draw(i, camera, upsampled=1)
            shares.append(((z > 0) & (z < depth)).mean())
            hidden.append(((z > 0) & ((z > depth - _GAP_M) | (z < _NEAREST_M))).mean())
        return float(np.mean(shares)), float(np.mean(hidden))

    def draw(
        self, index: int, camera: Camera, upsampled: int = _UPSAMPLED
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The person in a frame of the host: colour float32 ``[H, W, 3]``, depth float32 ``[H, W]``, 0 where it is not.

        Between two cutouts the earlier one is moved by a part of the step of its centre.

        Args:
            index: The frame.
            camera: Intrinsics of the host's image.
            upsampled: Factor by which the cutout's resolution is increased.
        """
        # Points of the earlier cutout, moved towards the later one.
        at = self.played[index]
        cutouts = self.cutouts
        last = len(cutouts.centres) - 1
        earlier = min(int(at), last)
        later = min(int(at) + 1, last)
        rgb, pixels, depth = _upsampled(cutouts.cutout(earlier), upsampled)
        step_m = (at - earlier) * (cutouts.centres[later] - cutouts.centres[earlier])
        moved = cutouts.camera.unproject(cutouts.camera.undistort_points(pixels), depth) + step_m

        # Project them into the host's image.
        T_cam_people = se3.inverse(self.T_world_cam[index]) @ self.T_world_people
        points = se3.transform(T_cam_people, moved)
        uv, visible = camera.view(points)
        at_pixels = np.rint(camera.distort_points(uv)).astype(int)
        inside = (at_pixels >= 0).all(axis=1)
        inside &= (at_pixels < (camera.width, camera.height)).all(axis=1)
        visible &= (points[:, 2] > 0.8 * _NEAREST_M) & inside

        # The nearest point of each pixel is written last.
        order = np.flatnonzero(visible)[np.argsort(-points[visible, 2])]
        columns, rows = at_pixels[order].T
        z = np.zeros((camera.height, camera.width), np.float32)
        colour = np.zeros((*z.shape, 3), np.float32)
        colour[rows, columns] = rgb[order]
        z[rows, columns] = points[order, 2]
        return _closed(colour, z)


def _nearest(
    drawn: list[tuple[NDArray[np.float32], NDArray[np.float32]]],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.intp]]:
    """Colour and depth of the nearest of several people at each pixel, and who that is, counted from 1."""
    depths = np.stack([np.where(z > 0, z, np.inf) for _, z in drawn])
    who = depths.argmin(axis=0)[None]
    z = np.take_along_axis(depths, who, axis=0)[0]
    colours = np.stack([colour for colour, _ in drawn])
    colour = np.take_along_axis(colours, who[..., None], axis=0)[0]
    return colour, np.where(np.isfinite(z), z, 0).astype(np.float32), who[0] + 1


def _upsampled(
    cutout: Cutout, times: int
) -> tuple[NDArray[np.float32], Array, NDArray[np.float32]]:
    """Colours ``[N, 3]``, pixels ``[N, 2]`` and depths ``[N]`` of a cutout at several times its resolution."""
    # The part of the image around the person.
    rgb, depth, person = cutout
    rows, columns = np.nonzero(person)
    top = max(rows.min() - 1, 0)
    left = max(columns.min() - 1, 0)
    part = np.s_[top : rows.max() + 2, left : columns.max() + 2]
    mask = person[part].astype(np.float32)
    depth = depth[part]

    # Depth is interpolated within a part of the body, not across the edge between two.
    size = (times * mask.shape[1], times * mask.shape[0])
    weight = cv2.resize(mask, size, interpolation=cv2.INTER_LINEAR)
    smooth = cv2.resize(depth, size, interpolation=cv2.INTER_LINEAR)
    nearest = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST)
    edge = (cv2.dilate(depth, _SQUARE) - cv2.erode(depth, _SQUARE) > _EDGE_M).astype(np.uint8)
    stepped = cv2.resize(edge, size, interpolation=cv2.INTER_NEAREST) > 0
    colours = cv2.resize(rgb[part].astype(np.float32), size, interpolation=cv2.INTER_CUBIC)

    inside = np.nonzero(weight > 0.5)
    pixels = (np.stack(inside[::-1], axis=1) + 0.5) / times - 0.5 + (left, top)
    return colours[inside].clip(0, 255), pixels, np.where(stepped, nearest, smooth)[inside]


def _closed(
    colour: NDArray[np.float32], z: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Colour and depth without the small holes between drawn points, which get the mean of their neighbours."""
    # holes are what closing by 5x5 pixels fills; their values: the mean of the drawn neighbours
    drawn = (z > 0).astype(np.float32)
    whole = cv2.morphologyEx(drawn, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0
    count = cv2.blur(drawn, (5, 5))
    hole = whole & (drawn == 0) & (count > 0)
    colour[hole] = cv2.blur(colour, (5, 5))[hole] / count[hole, None]
    z[hole] = cv2.blur(z, (5, 5))[hole] / count[hole]
    return colour, z


def paste(
    rgb: NDArray[np.uint8],
    depth: NDArray[np.float32],
    colour: NDArray[np.float32],
    z: NDArray[np.float32],
    camera: Camera,
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.bool_]]:
    """Put drawn people into a frame: in front of what is farther, with blended edges and a depth camera's shadow.

    Args:
        rgb: The host's colours, uint8 ``[H, W, 3]``.
        depth: Its depth in metres ``[H, W]``, 0 where there is none: it is taken for that of the
            nearest measurement.
        colour: The people's colours ``[H, W, 3]``.
        z: The people's depth in metres ``[H, W]``, 0 where nobody is.
        camera: The host's.

    Returns:
        Colour, depth, and where people are seen, bool ``[H, W]``.
    """
    # Where people are in front of the host's surfaces.
    everywhere = _smoothed(_filled(depth))
    in_front = ((z > 0) & (_smoothed(z) < everywhere)).astype(np.uint8)
    shown = cv2.morphologyEx(in_front, cv2.MORPH_OPEN, _LEAST_DISC) > 0
    # Blend their edges with the host's colours.
    alpha = cv2.GaussianBlur(shown.astype(np.float32), (3, 3), 0.6)[..., None]
    spread = cv2.blur(shown.astype(np.float32), (3, 3))[..., None]
    near = cv2.blur(np.where(shown[..., None], colour, 0), (3, 3)) / np.maximum(spread, 1e-6)
    person = np.where(shown[..., None], colour, near)
    mixed = np.where(alpha > 0, alpha * person + (1 - alpha) * rgb, rgb)
    # Their depth, and none in their shadow.
    composed = np.where(shown, z, depth)
    composed[_shadow(shown, z, everywhere, camera) & ~shown] = 0
    return np.rint(mixed).clip(0, 255).astype(np.uint8), composed.astype(np.float32), shown


def _shadow(
    shown: NDArray[np.bool_], z: NDArray[np.float32], behind: NDArray[np.float32], camera: Camera
) -> NDArray[np.bool_]:
    """Pixels ``[H, W]`` in the person's shadow, which a projector to the right of the depth camera does not light."""
    # Disparities in pixels of the person and of what is behind; a pixel is dark if a surface some
    # pixels to its right has a disparity that is larger by more than these pixels.
    scale = camera.fx * _SHADOW_BASELINE_M
    ahead = np.where(shown, scale / np.maximum(z, 0.1), 0)
    back = scale / np.maximum(behind, 0.1)
    dark = np.zeros_like(shown)
    for shift in range(1, _FURTHEST_SHADOW_PX):
        dark[:, :-shift] |= ahead[:, shift:] - back[:, :-shift] > shift
    return dark
