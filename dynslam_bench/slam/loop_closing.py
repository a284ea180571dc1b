"""Loop closing, the last row of the paper's Figure 2: recognise a place, verify it, correct the map, fuse it.

1. *Detect*: old keyframes that are weakly connected with the newest one are ranked by place recognition. The best few
   of those that score no less than its neighbours are matched feature by feature.
2. *Verify*: a pose by RANSAC, then by all points around the candidate, and without depth the scale. It must explain
   most of what should be in view, agree with the keyframes before, and ask for no more correction
   than the path since the candidate may have drifted. The last condition is this project's:
   buildings that repeat pass all others.
3. *Correct*: a pose graph over all keyframes: neighbours, those that share many points, all loop edges. Without depth
   the scale drifts as well: each keyframe's scale is solved first, then the poses. A submap is
   merged instead: it is moved as a whole.
4. *Fuse*: duplicate points of both visits are merged, and the local map is adjusted.

Lengths are metres; without depth they are in units of the root map's median depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
from scipy.sparse import bsr_array, coo_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve

from dynslam_bench.core.seeding import stream
from dynslam_bench.geometry import se3
from dynslam_bench.slam.atlas import Atlas
from dynslam_bench.slam.local_mapping import LocalMapper
from dynslam_bench.slam.map import Array, Slots
from dynslam_bench.slam.observations import Observations
from dynslam_bench.slam.relocalisation import (
    is_aliased,
    keyframe_neighbourhood,
    pose_uncertainty,
    recognise_place,
    recognition_scores,
)
from dynslam_bench.slam.settings import BackendSettings
from dynslam_bench.slam.tracking import InitialPose, weakly_connected

CANDIDATES = 3
"""Best-ranked keyframes that are matched feature by feature."""
MIN_MATCHES = 20
"""Descriptor matches that a candidate needs; half of them must be RANSAC inliers."""
MIN_SHARE = 0.3
"""Share of the candidate's own points in view that must be seen."""
MERGE_INLIERS = 100
"""Inliers that a merge of two maps needs, which no drift bounds."""
MERGE_SHARE = 0.5
"""`MIN_SHARE` where two maps are merged."""
MERGE_UNCERTAINTY = 0.4
"""Largest `relocalisation.pose_uncertainty` of a pose by which maps are merged."""
STRONG_COVISIBILITY = 100
"""Keyframes that share so many points have an edge in the pose graph (ORB-SLAM2's number)."""
SLACK_M = 0.1
"""Distance that is accepted as a correction however short the path is."""
SLACK_DEG = 3.0
"""Rotation that is accepted as a correction however short the path is."""
DRIFT_DEG = 0.5
"""Largest rotation that is accepted, degrees a metre (or unit of length) of path."""
ROTATION_M = 3.0
"""Path length that a rotation by one radian counts as with depth: it renews the view as much as passing a wall so far
away."""
ROTATION_DEPTHS = 1.0
"""`ROTATION_M` without depth, in median depths of the initial map."""
DRIFT_SECTION = 100.0
"""Path along which drift adds up; sections of a longer one drift independently, so that its root counts."""
NEGLIGIBLE = 0.01, 0.3, 0.01
"""A smaller correction is left to fusion and bundle adjustment: distance, degrees, logarithm of the scale."""
MAX_SCALE = 3.0
"""Factor by which scale may have drifted at most."""
MIN_SCALE_POINTS = 20
"""Features with a point of both visits that determine the scale at least."""
LOOP_WEIGHT = 100.0
"""Information weight of a loop edge, where other edges have 1: an error left between two visits bends both."""
PATIENCE = 5
"""Frames after which a camera leaves a submap for the root map if the two were not merged by then."""
AGREE_M = 0.1
"""Largest distance between the corrections of consecutive keyframes, metres or units of length."""
AGREE_DEG = 2.0
"""Largest rotation between the corrections of consecutive keyframes, degrees."""
AGREE_SCALE = 0.1
"""Largest difference of the logarithms of their scales."""
SIGMAS = (0.02, 0.02, 0.02, 0.01, 0.01, 0.01)
"""Standard deviations of an edge of weight 1: metres (units without depth) and radians; only their ratio matters."""
GRAPH_ITERATIONS = 20
"""Levenberg-Marquardt steps of the pose graph at most."""
MIN_GAIN = 1e-9
"""The pose graph is solved when a step lowers its cost by a smaller share."""


@dataclass(frozen=True, eq=False)
class Correction:
    """The similarity that a keyframe asks for when it recognises a place.

    Attributes:
        T_cam_before: Its pose ``[4, 4]`` as the map has it, world to camera.
        T_cam_now: Its pose by the place that it recognises.
        scale: What lengths around it are to be multiplied by.
    """

    T_cam_before: Array
    T_cam_now: Array
    scale: float

    @property
    def moved_m(self) -> float:
        """Distance that the camera centre moves."""
        centres = se3.inverse(np.stack([self.T_cam_before, self.T_cam_now]))[:, :3, 3]
        return float(np.linalg.norm(centres[1] - centres[0]))

    @property
    def rotated_deg(self) -> float:
        """Angle that the camera rotates by, degrees."""
        return float(
            np.degrees(se3.rotation_angle(self.T_cam_now @ se3.inverse(self.T_cam_before)))
        )

    @property
    def T_now_before(self) -> Array:
        """Transform ``[4, 4]`` from the keyframe's world, once its lengths are multiplied, to the place's world."""
        # the pose with its translation in the new unit, then by way of the camera
        before = self.T_cam_before.copy()
        before[:3, 3] *= self.scale
        return se3.inverse(self.T_cam_now) @ before

    @property
    def inverse(self) -> Correction:
        """The correction of the place if the keyframe stays instead."""
        return Correction(self.T_cam_now, self.T_cam_before, 1 / self.scale)

    def moved(self, at: Array) -> Array:
        """Move a place ``[3]`` near the keyframe as the correction does, ``[3]``."""
        # in the camera frame, in the new unit; then by the new pose
        local = self.scale * se3.transform(self.T_cam_before, at[None])
        return np.asarray(se3.transform(se3.inverse(self.T_cam_now), local)[0])

    def agrees(self, other: Correction, at: Array) -> bool:
        """Whether another correction moves a place nearly as this one does."""
        # compared at the camera, since far from it a small rotation moves much
        distance = np.linalg.norm(self.moved(at) - other.moved(at))
        rotation = se3.rotation_angle(self.T_now_before @ se3.inverse(other.T_now_before))
        scale = abs(np.log(self.scale / other.scale))
        return bool(distance < AGREE_M and np.degrees(rotation) < AGREE_DEG and scale < AGREE_SCALE)


@dataclass(frozen=True, eq=False)
class Loop:
    """A place that was recognised.

    Attributes:
        place: Pose of the newest keyframe by the points around the one that was recognised.
        correction: What follows for the newest keyframe; its scale is 1 with depth.
        merges: Whether the place lies in another submap.
        fits: Whether the submap can have begun where the merge puts its start; not so after much
            drift.
    """

    place: InitialPose
    correction: Correction
    merges: bool
    fits: bool = True


class RootMapPose(Enum):
    """Verdict on a pose in the root map that was found for a camera in a submap."""

    REJECTED = "rejected"
    """There is none, or it is ambiguous or cannot be reached: the frame is tracked in the submap alone."""
    ACCEPTED = "accepted"
    """The pose counts for the frame; tracking continues in the submap, which may be merged later."""
    CONTINUE_THERE = "continue there"
    """The pose counts, and tracking continues in the root map: the two maps are not merged."""


@dataclass(frozen=True, eq=False)
class LoopClosingResult:
    """The result of `LoopCloser.close`.

    Attributes:
        rescaled: What lengths around keyframes were multiplied by, by the keyframes' slots; with
            depth the keyframes that were moved to another map.
        root_map_pose: Whether the camera's pose in the root map counts.
    """

    rescaled: dict[int, float] = field(default_factory=dict)
    root_map_pose: RootMapPose = RootMapPose.REJECTED


class LoopCloser:
    """Looks for loops at every new keyframe, and closes them.

    Args:
        atlas: The maps.
        mapper: Fuses and adjusts.
        settings: Settings of the back end.
        seed: Founds RANSAC's draws.
        scale_is_known: Whether lengths are metres everywhere, as with depth.

    Attributes:
        closed: All loops that were closed.
    """

    def __init__(
        self,
        atlas: Atlas,
        mapper: LocalMapper,
        settings: BackendSettings,
        seed: int,
        *,
        scale_is_known: bool = True,
    ) -> None:
        self.atlas = atlas
        self.map = atlas.map
        self.mapper = mapper
        self.settings = settings
        self.closed: list[Loop] = []
        self._seed = seed
        self._scale_is_known = scale_is_known
        # path length up to each keyframe, by its id
        self._path: dict[int, float] = {}
        self._path_length = 0.0
        # path lengths at the two ends of each closed loop
        self._shortcuts: list[tuple[float, float]] = []
        self._last_pose: Array | None = None
        # corrections of the latest consecutive keyframes, which agree with each other
        self._consistent: list[Correction] = []
        # frame since which a submap's camera is in the root map, too
        self._in_root_map_since: int | None = None
        self._loop_edges: list[Edge] = []

    def close(
        self, slot: int, observations: Observations, pose_in_root_map: InitialPose | None = None
    ) -> LoopClosingResult:
        """Look for a loop at a new keyframe; correct and fuse the map if enough consecutive keyframes agree on one.

        Args:
            slot: The keyframe.
            observations: Its features.
            pose_in_root_map: Its pose in the root map, if the camera is in a submap and was found there.
        """
        self._extend_path(slot)
        self._transfer_loop_edges()

        # detect a place and verify it
        root_map_pose = RootMapPose.REJECTED
        if pose_in_root_map is None:
            loop = self._verified(slot, observations)
        else:
            loop, root_map_pose = self._loop_to_root_map(slot, observations, pose_in_root_map)
        if root_map_pose is RootMapPose.REJECTED:
            self._in_root_map_since = None

        # consecutive keyframes have to agree on the correction
        confirmed = self._confirmed(slot, loop)
        if confirmed is None:
            return LoopClosingResult(root_map_pose=root_map_pose)
        if not confirmed.fits:
            # the submap has drifted too far to be merged
            if pose_in_root_map is not None:
                root_map_pose = RootMapPose.CONTINUE_THERE
            return LoopClosingResult(root_map_pose=root_map_pose)
        # the loop to the root map was tested for aliasing before
        if (
            confirmed.merges
            and pose_in_root_map is None
            and self._aliased(slot, observations, confirmed)
        ):
            return LoopClosingResult(root_map_pose=root_map_pose)

        # correct the map, or merge two maps
        if confirmed.merges:
            rescaled = self._merge(slot, confirmed)
        else:
            rescaled = self._correct(slot, confirmed)

        # fuse the points of both visits
        self._fuse(slot, confirmed.place.keyframe)
        self._shortcuts.append((self._path_at(confirmed.place.keyframe), self._path_length))
        self.closed.append(confirmed)
        # the path goes on from the corrected pose: a correction adds none
        self._last_pose = self.map.kf_pose[slot].copy()
        return LoopClosingResult(rescaled, root_map_pose)

    def _transfer_loop_edges(self) -> None:
        """Move the loop edges of culled keyframes to the replacements."""
        if not self._loop_edges:
            return
        for culled, replacement, T_culled_replacement in self.mapper.culled:
            self._loop_edges = transferred_edges(
                self._loop_edges,
                int(self.map.kf_id[culled]),
                int(self.map.kf_id[replacement]),
                T_culled_replacement,
            )

    def _confirmed(self, slot: int, loop: Loop | None) -> Loop | None:
        """The loop with the median scale of all keyframes that agree on it, once there are enough; else None."""
        # a keyframe without a loop breaks the row
        if loop is None:
            self._consistent.clear()
            return None
        # so does one whose correction differs from the last one's
        centre = self.map.kf_centre[slot]
        if self._consistent and not loop.correction.agrees(self._consistent[-1], centre):
            self._consistent.clear()
        self._consistent.append(loop.correction)
        # wait for more, then take the median of their scales
        if len(self._consistent) < self.settings.loop_closing.confirmations:
            return None
        scale = float(np.median([correction.scale for correction in self._consistent]))
        self._consistent.clear()
        return replace(loop, correction=replace(loop.correction, scale=scale))

    # ------------------------------------------------------------------ detect and verify

    def _extend_path(self, slot: int) -> None:
        """Add the way from the last keyframe to the path length: drift grows with it."""
        pose = self.map.kf_pose[slot].copy()
        number = int(self.map.kf_id[slot])
        # the first two views of a submap
        for begun in range(next(reversed(self._path), number - 1) + 1, number):
            self._path[begun] = self._path_length

        # distance, and rotation as if it were one
        if self._last_pose is not None:
            step = pose @ se3.inverse(self._last_pose)
            length_per_radian = ROTATION_M if self._scale_is_known else ROTATION_DEPTHS
            self._path_length += float(
                np.linalg.norm(step[:3, 3]) + length_per_radian * se3.rotation_angle(step)
            )
        self._last_pose = pose
        self._path[number] = self._path_length

    def _verified(self, slot: int, observations: Observations) -> Loop | None:
        """The first of the best-ranked candidates that is verified."""
        # keyframes that drift may separate from this one, of this map or, for a merge, the root map
        slam_map = self.map
        old = weakly_connected(slam_map, slot)
        there = slam_map.kf_map[old]
        here = slam_map.kf_map[slot]
        old = old[(there == here) | (there == 0) | (here == 0)]
        if not len(old):
            return None

        # by place recognition: a candidate has to score as well as the worst of the neighbours
        near = np.setdiff1d(keyframe_neighbourhood(slam_map, slot)[1:], old)
        score = recognition_scores(slam_map, np.concatenate([near, old]), observations)
        least = score[: len(near)].min(initial=np.inf)
        score = score[len(near) :]

        # by geometry: the first one that is verified
        rng = stream(self._seed, "loop", int(slam_map.kf_id[slot]))
        for k in np.argsort(-score, kind="stable")[:CANDIDATES]:
            if score[k] >= least:
                loop = self._verified_candidate(slot, int(old[k]), observations, rng)
                if loop is not None:
                    return loop
        return None

    def _verified_candidate(
        self, slot: int, candidate: int, observations: Observations, rng: np.random.Generator
    ) -> Loop | None:
        """The loop to a candidate, if the points around it explain enough and drift explains the correction.

        Args:
            slot: The newest keyframe.
            candidate: The keyframe whose place it may show.
            observations: Features of the newest keyframe.
            rng: Draws RANSAC's samples.
        """
        # the pose by the points around the candidate
        s = self.settings.loop_closing
        tracking = self.settings.tracking
        least = MIN_MATCHES, MIN_MATCHES // 2
        place = recognise_place(self.map, candidate, observations, tracking, rng, *least)
        if place is None or len(place.matches) < s.min_inliers or place.seen_share < MIN_SHARE:
            return None

        # the correction, which drift has to explain; for a merge the pose must be well determined
        loop = self._loop(slot, place)
        if loop is None or (
            loop.merges and pose_uncertainty(self.map, observations, place, rng) > MERGE_UNCERTAINTY
        ):
            return None
        return loop if self._within_drift(slot, loop) else None

    def _loop_to_root_map(
        self, slot: int, observations: Observations, place: InitialPose
    ) -> tuple[Loop | None, RootMapPose]:
        """The loop to the place in the root map where a submap's camera is, and whether the pose there counts.

        The loop is None where the place does not determine the merge well enough.

        Args:
            slot: The submap's newest keyframe, a row of the map's arrays of keyframes.
            observations: Its features.
            place: Its camera's pose in the root map, with the matches that gave it.
        """
        # a place whose keyframe was culled since counts no more, and one that fits twice neither
        loop = self._loop(slot, place)
        if loop is None or not self.map.kf_alive[place.keyframe]:
            return None, RootMapPose.REJECTED
        # without a known scale a loop that does not fit is rejected below, ambiguous or not
        ambiguity_counts = loop.fits or self._scale_is_known
        if ambiguity_counts and self._aliased(slot, observations, loop):
            return None, RootMapPose.REJECTED

        # a merge needs more than a pose
        determined = (
            len(place.matches) >= self.settings.loop_closing.min_inliers
            and place.seen_share >= MERGE_SHARE
            and place.uncertainty <= MERGE_UNCERTAINTY
        )
        merge = loop if determined else None
        if not loop.fits:
            return merge, RootMapPose.REJECTED

        # a camera that waits too long for a merge leaves the submap
        frame = int(self.map.kf_frame[slot])
        if self._in_root_map_since is None:
            self._in_root_map_since = frame
        waited = frame - self._in_root_map_since
        if not determined and waited >= PATIENCE:
            return merge, RootMapPose.CONTINUE_THERE
        return merge, RootMapPose.ACCEPTED

    def _loop(self, slot: int, place: InitialPose) -> Loop | None:
        """The correction to a place; None where too few points determine the scale."""
        scale = 1.0 if self._scale_is_known else self._scale(slot, place)
        if scale is None:
            return None
        correction = Correction(self.map.kf_pose[slot].copy(), place.T_cam_world, scale)
        loop = Loop(
            place, correction, bool(self.map.kf_map[place.keyframe] != self.map.kf_map[slot])
        )
        return replace(loop, fits=self._fits(slot, loop)) if loop.merges else loop

    def _scale(self, slot: int, place: InitialPose) -> float | None:
        """Median ratio of the depths of common points by the first visit and by this one; None where too few."""
        # features with a point of each visit
        slam_map = self.map
        first = place.matches
        own = slam_map.kf_point[slot, first.feature].astype(np.int64)
        both = (own >= 0) & (own != first.point)

        # depths of both points before the camera, each by its visit's pose
        first_z = se3.transform(place.T_cam_world, slam_map.position[first.point[both]])[:, 2]
        own_z = se3.transform(slam_map.kf_pose[slot], slam_map.position[own[both]])[:, 2]
        ahead = (first_z > 0) & (own_z > 0)
        if ahead.sum() < MIN_SCALE_POINTS:
            return None
        return float(np.exp(np.median(np.log(first_z[ahead] / own_z[ahead]))))

    def _within_drift(self, slot: int, loop: Loop) -> bool:
        """Whether drift explains the correction; between submaps, whether the camera can have moved from one there."""
        place = loop.place
        correction = loop.correction
        # between submaps: matches, and the rotation that the maps may have against each other
        if loop.merges:
            if len(place.matches) < MERGE_INLIERS or place.seen_share < MERGE_SHARE:
                return False
            slack = self.atlas.slack(*self.map.kf_map[[slot, place.keyframe]].tolist())
            return loop.fits and bool(np.radians(correction.rotated_deg) <= slack)

        # within a map: scale, distance and rotation in proportion to the path
        if not 1 / MAX_SCALE < correction.scale < MAX_SCALE:
            return False
        path = self._path_since(place.keyframe)
        share = self.settings.loop_closing.drift_share
        return (
            correction.moved_m <= SLACK_M + share * path
            and correction.rotated_deg <= SLACK_DEG + DRIFT_DEG * path
        )

    def _fits(self, slot: int, loop: Loop) -> bool:
        """Whether the younger of two submaps can have begun where the merge puts its start."""
        # path from where the older map was left, on either map, to the two ends of the loop
        younger, _, correction = self._merge_of(slot, loop)
        share = 0.0 if self._scale_is_known else self.settings.loop_closing.drift_share
        left = self._path_at(int(self.map.submap(younger)[0]))
        place = loop.place.keyframe
        ends = (slot, place) if self.map.kf_map[slot] == younger else (place, slot)
        on_younger, on_older = (abs(self._path_at(keyframe) - left) for keyframe in ends)
        # from the meeting place back to where the older was left
        path = correction.scale * on_younger + on_older
        return self.atlas.admits_start(younger, correction.moved, share * path)

    def _aliased(self, slot: int, observations: Observations, loop: Loop) -> bool:
        """Whether the keyframe fits two places: nothing but what is seen tells how two maps lie to each other."""
        slam_map = self.map
        place = loop.place
        own, other = slam_map.kf_map[[slot, place.keyframe]].tolist()
        points = slam_map.kf_point[slot, slam_map.kf_point[slot] >= 0]
        depth = float(
            np.median(se3.transform(slam_map.kf_pose[slot], slam_map.position[points])[:, 2])
        )

        # both hypotheses of where the camera is, by the map that says so
        hypotheses = {
            own: replace(place, T_cam_world=slam_map.kf_pose[slot], depth=depth),
            other: replace(place, depth=depth * loop.correction.scale),
        }
        tracking = self.settings.tracking
        return is_aliased(
            slam_map,
            observations,
            hypotheses,
            weakly_connected(slam_map, slot),
            tracking,
            self._seed,
        )

    def _path_since(self, slot: int) -> float:
        """The path whose drift adds up since a keyframe: the length since then, or over a closed loop."""
        # the shortest way along the path and over one closed loop
        then = self._path_at(slot)
        shortcuts = (abs(then - old) + self._path_length - new for old, new in self._shortcuts)
        # beyond a section drift grows as the root of the path
        path = min([self._path_length - then, *shortcuts])
        return min(path, float(np.sqrt(DRIFT_SECTION * path)))

    def _path_at(self, slot: int) -> float:
        """Path length up to a keyframe; 0 for those of a loaded map."""
        return self._path.get(int(self.map.kf_id[slot]), 0.0)

    # ------------------------------------------------------------------ correct and fuse

    def _correct(self, slot: int, loop: Loop) -> dict[int, float]:
        """Spread the correction over all keyframes of the map by a pose graph; returns the scales of those rescaled."""
        # the loop edge; a small correction is left to fusion and bundle adjustment
        slam_map = self.map
        correction = loop.correction
        loop_edge = self._edge(loop.place.keyframe, slot, correction.T_cam_now, LOOP_WEIGHT)
        older = edges_within(slam_map.kf_id[slam_map.keyframes], self._loop_edges)
        self._loop_edges = [*older, loop_edge]
        log_scale = abs(np.log(correction.scale))
        size = np.array([correction.moved_m, correction.rotated_deg, log_scale])
        if (size < NEGLIGIBLE).all():
            return {}

        # the essential graph: keyframes of the map and edges of strong covisibility
        submap = int(slam_map.kf_map[slot])
        slots = slam_map.submap(submap)
        ids = slam_map.kf_id[slots]
        poses_before = slam_map.kf_pose.copy()
        edges = self._covisibility_edges(slots)

        # without depth the scales first
        rescaled: dict[int, float] = {}
        scales = np.ones(slam_map.kf_alive.size)
        if not self._scale_is_known:
            kept_scale = [*edges, *edges_within(ids, older)]
            scales[slots] = spread_scale(ids, kept_scale, loop_edge, correction.scale)
            edges = rescaled_edges(edges, ids, scales[slots])
            rescaled = self._rescale_loop_edges(slots, scales[slots])

        # then the poses
        graph = [*edges, *edges_within(ids, self._loop_edges)]
        poses = optimise_poses(ids, poses_before[slots], graph)
        for keyframe, pose in zip(slots.tolist(), poses, strict=True):
            slam_map.set_pose(keyframe, pose)
        self.atlas.move_nearby(submap, poses_before[slots], poses, scales[slots])
        self._move_points(slots, poses_before, scales)
        return rescaled

    def _move_points(self, slots: Slots, poses_before: Array, scales: Array) -> None:
        """Move each point of corrected keyframes with the first keyframe that observes it.

        Args:
            slots: The keyframes.
            poses_before: World-to-camera poses ``[S, 4, 4]`` of all slots before the correction.
            scales: What lengths around each slot are multiplied by ``[S]``.
        """
        # in the frame of the first observer's camera, as it was
        slam_map = self.map
        points = slam_map.points_of(slots)
        reference = slam_map.obs_kf[points, 0]
        R_before = poses_before[reference, :3, :3]
        t_before = poses_before[reference, :3, 3]
        local = np.einsum("nij,nj->ni", R_before, slam_map.position[points]) + t_before
        local *= scales[reference, None]

        # back to the world by the corrected pose
        T_world_cam = se3.inverse(slam_map.kf_pose[reference])
        R_after = T_world_cam[:, :3, :3]
        t_after = T_world_cam[:, :3, 3]
        slam_map.position[points] = np.einsum("nij,nj->ni", R_after, local) + t_after
        slam_map.refresh(points)

    def _merge_of(self, slot: int, loop: Loop) -> tuple[int, int, Correction]:
        """The younger of the two submaps, the older one, and the correction of the younger."""
        own, other = self.map.kf_map[[slot, loop.place.keyframe]].tolist()
        if own > other:
            return own, other, loop.correction
        return other, own, loop.correction.inverse

    def _merge(self, slot: int, loop: Loop) -> dict[int, float]:
        """Merge two submaps (ORB-SLAM3's ``MergeLocal``): the younger moves onto the older or the root map.

        Returns the scales of the keyframes that were moved, by slot.
        """
        slam_map = self.map
        younger, older, correction = self._merge_of(slot, loop)
        # move the younger map's keyframes and points
        slots = slam_map.move_submap(younger, correction.T_now_before, older, correction.scale)
        rescaled = self._rescale_loop_edges(slots, np.full(len(slots), correction.scale))

        # connect the two by the place that both show
        loop_edge = self._edge(loop.place.keyframe, slot, slam_map.kf_pose[slot], LOOP_WEIGHT)
        self._loop_edges.append(loop_edge)
        return rescaled

    def _rescale_loop_edges(self, slots: Slots, scales: Array) -> dict[int, float]:
        """Multiply the lengths of loop edges at keyframes ``[N]`` by scales ``[N]``; returns the scales by slot."""
        self._loop_edges = rescaled_edges(self._loop_edges, self.map.kf_id[slots], scales)
        return dict(zip(slots.tolist(), scales.tolist(), strict=True))

    def _edge(self, one: int, other: int, pose_of_other: Array, weight: float = 1.0) -> Edge:
        """The edge between two keyframes by the pose of the first and one of the other, both world to camera.

        Args:
            one: Slot of the first keyframe.
            other: Slot of the other.
            pose_of_other: World to camera ``[4, 4]``, as the edge has it.
            weight: Information weight.
        """
        id_one, id_other = self.map.kf_id[[one, other]].tolist()
        return Edge(id_one, id_other, pose_of_other @ se3.inverse(self.map.kf_pose[one]), weight)

    def _covisibility_edges(self, slots: Slots) -> list[Edge]:
        """Edges of each keyframe to the older ones that share many points, and to the one that shares most.

        Neighbours in time that share nothing have none: the camera was lost between them.
        """
        pairs = set()
        for slot in slots.tolist():
            near, shared = self.map.covisible(slot)
            older = self.map.kf_id[near] < self.map.kf_id[slot]
            # the one that shares most, and all that share many
            linked = [*near[older][:1], *near[older & (shared >= STRONG_COVISIBILITY)]]
            pairs |= {(int(other), slot) for other in linked}
        return [self._edge(a, b, self.map.kf_pose[b]) for a, b in sorted(pairs)]

    def _fuse(self, slot: int, candidate: int) -> None:
        """Fuse the points around both ends of a loop, and adjust what lies around the new keyframe."""
        # points around the recognised keyframe, matched in each keyframe around the new one
        points = self.map.points_of(keyframe_neighbourhood(self.map, candidate))
        for keyframe in keyframe_neighbourhood(self.map, slot).tolist():
            self.mapper.fuse_into(keyframe, points)
        self.map.refresh(points[self.map.alive[points]])
        self.mapper.adjust(slot)


# ---------------------------------------------------------------------- the pose graph


@dataclass(frozen=True, eq=False)
class Edge:
    """A constraint between two keyframes.

    Attributes:
        one: Id of the first.
        other: Id of the second.
        T_other_one: Pose ``[4, 4]`` from the first one's camera frame to the other's.
        weight: Information weight.
    """

    one: int
    other: int
    T_other_one: Array
    weight: float = 1.0


def rescaled_edges(edges: Sequence[Edge], ids: Slots, factors: Array) -> list[Edge]:
    """The edges after lengths at keyframes were multiplied by factors."""
    # the translation of an edge is a length at its first keyframe
    by_id = dict(zip(ids.tolist(), factors.tolist(), strict=True))
    poses = np.array([edge.T_other_one for edge in edges]).reshape(-1, 4, 4)
    poses[:, :3, 3] *= np.reshape([by_id.get(edge.one, 1.0) for edge in edges], (-1, 1))
    return [replace(edge, T_other_one=pose) for edge, pose in zip(edges, poses, strict=True)]


def transferred_edges(
    edges: Sequence[Edge], culled: int, replacement: int, T_culled_replacement: Array
) -> list[Edge]:
    """The edges after a keyframe was culled, moved to its replacement; an edge from that to itself is left out.

    Args:
        edges: The edges.
        culled: Id of the culled keyframe.
        replacement: Id of its replacement.
        T_culled_replacement: Pose ``[4, 4]`` from the replacement's camera frame to that of the
            culled one.
    """
    transferred = []
    for edge in edges:
        # T_other_replacement = T_other_culled T_culled_replacement
        if edge.one == culled:
            edge = replace(
                edge, one=replacement, T_other_one=edge.T_other_one @ T_culled_replacement
            )
        # T_replacement_one = T_replacement_culled T_culled_one
        if edge.other == culled:
            edge = replace(
                edge,
                other=replacement,
                T_other_one=se3.inverse(T_culled_replacement) @ edge.T_other_one,
            )
        transferred.append(edge)
    return [edge for edge in transferred if edge.one != edge.other]


def edges_within(ids: Slots, edges: Sequence[Edge]) -> list[Edge]:
    """The edges between keyframes of some ids."""
    return [edge for edge in edges if np.isin([edge.one, edge.other], ids).all()]


def spread_scale(ids: Slots, edges: Sequence[Edge], loop_edge: Edge, scale: float) -> Array:
    """Factors for the lengths at each keyframe with which a loop edge's scale is met.

    Logarithms of scales are to be equal at both ends of an edge, and to differ by that of `scale`
    at the loop edge's. The sum of squared errors is least. Strasdat, Montiel and Davison (Scale
    Drift-Aware Large Scale Monocular SLAM, RSS 2010) solve for scales and poses together.

    Args:
        ids: Ids of the keyframes, int64 ``[N]``, ascending.
        edges: Edges along which scale was kept. The oldest keyframe of each connected component
            stays.
        loop_edge: Edge from the keyframe that was recognised to the one that recognises it.
        scale: What lengths at the second are to be multiplied by beside those at the first.

    Returns:
        Factors ``[N]``.
    """
    # the wanted difference of the logarithms along each edge: 0, but for the loop's
    all_edges = [*edges, loop_edge]
    one, other = np.searchsorted(ids, [[edge.one, edge.other] for edge in all_edges]).T
    row = np.arange(len(all_edges))
    wanted = np.zeros(len(all_edges))
    wanted[-1] = np.log(scale)

    # the oldest keyframe of each component stays
    _, part = connected_components(
        coo_array((np.ones(len(row)), (one, other)), shape=(len(ids), len(ids))), False
    )
    _, oldest = np.unique(part, return_index=True)
    free = np.setdiff1d(np.arange(len(ids)), oldest)

    # weighted least squares by the normal equations; a row of the Jacobian holds -1 and 1
    ends = np.r_[row, row], np.r_[one, other]
    values = np.r_[-np.ones(len(row)), np.ones(len(row))]
    jacobian = coo_array((values, ends), shape=(len(row), len(ids))).tocsc()[:, free]
    weight = diags_array(np.array([edge.weight for edge in all_edges]))
    logarithms = np.zeros(len(ids))
    logarithms[free] = spsolve(
        (jacobian.T @ weight @ jacobian).tocsc(), jacobian.T @ (weight @ wanted)
    )
    return np.asarray(np.exp(logarithms))


def optimise_poses(ids: Slots, poses: Array, edges: Sequence[Edge]) -> Array:
    """The poses that fit the edges best; the first one stays.

    Args:
        ids: Ids of the keyframes whose poses are optimised, int64 ``[N]``, ascending.
        poses: World to camera ``[N, 4, 4]``, where the search starts.
        edges: Edges between them; the graph must be connected.

    Returns:
        World to camera ``[N, 4, 4]``.
    """
    # rows of the poses at both ends, the inverse of each measured pose, and its standard deviations
    one, other = np.searchsorted(ids, [[edge.one, edge.other] for edge in edges]).T
    T_one_other = se3.inverse(np.array([edge.T_other_one for edge in edges]))
    sigmas = SIGMAS / np.sqrt([[edge.weight] for edge in edges])
    error = _edge_errors(poses, one, other, T_one_other, sigmas)
    cost = float(np.square(error).sum())

    # Levenberg-Marquardt: a step that does not lower the cost is repeated with more damping
    damping = 1e-6
    for _ in range(GRAPH_ITERATIONS):
        trial = se3.exp(_graph_step(poses, one, other, error, sigmas, damping)) @ poses
        trial_error = _edge_errors(trial, one, other, T_one_other, sigmas)
        lower = float(np.square(trial_error).sum())
        if not lower < cost:
            damping *= 30.0
            continue
        done = cost - lower <= MIN_GAIN * cost
        poses = trial
        error = trial_error
        cost = lower
        damping = max(damping * 0.2, 1e-12)
        if done:
            break
    return poses


def _edge_errors(
    poses: Array, one: Slots, other: Slots, T_one_other: Array, sigmas: Array
) -> Array:
    """Error of each edge ``[E, 6]``: the twist left between it and the poses, in its sigmas.

    Args:
        poses: World to camera ``[N, 4, 4]``.
        one: Row of the pose at the first end of each edge ``[E]``.
        other: Row of the pose at the other end ``[E]``.
        T_one_other: Measured poses ``[E, 4, 4]`` from the other camera's frame to the first one's.
        sigmas: Standard deviations ``[E, 6]``.
    """
    # identity if T_other_one of the poses is the measured one
    return se3.log(poses[other] @ se3.inverse(poses[one]) @ T_one_other) / sigmas


def _graph_step(
    poses: Array, one: Slots, other: Slots, error: Array, sigmas: Array, damping: float
) -> Array:
    """Twists ``[N, 6]`` on the left of the poses that lower the cost; that of the first one is zero.

    Args:
        poses: World to camera ``[N, 4, 4]``.
        one: Row of the pose at the first end of each edge ``[E]``.
        other: Row of the pose at the other end ``[E]``.
        error: Errors ``[E, 6]`` of the edges, in their sigmas.
        sigmas: Standard deviations ``[E, 6]``.
        damping: Levenberg-Marquardt's damping, relative to the diagonal.
    """
    # how each error follows a twist on the left of either pose: blocks [6, 6]
    jacobian_log = _inverse_left_jacobian(error * sigmas)
    weight = 1.0 / sigmas[:, :, None]
    by_other = weight * jacobian_log
    by_one = -by_other @ _adjoint(poses[other] @ se3.inverse(poses[one]))

    # the sparse Jacobian [6 E, 6 N - 6], two blocks a row; the first pose stays
    blocks = np.stack([by_one, by_other], axis=1).reshape(-1, 6, 6)
    columns = np.stack([one, other], axis=1).ravel()
    block_rows = blocks, columns, 2 * np.arange(len(error) + 1)
    jacobian = bsr_array(block_rows, shape=(error.size, 6 * len(poses))).tocsc()[:, 6:]

    # damped normal equations
    normal = (jacobian.T @ jacobian).tocsc()
    normal = normal + diags_array(damping * normal.diagonal() + 1e-12)
    twists = -spsolve(normal.tocsc(), jacobian.T @ error.ravel()).reshape(-1, 6)
    return np.concatenate([np.zeros((1, 6)), twists])


def _adjoint(pose: Array) -> Array:
    """Matrices ``[..., 6, 6]`` that turn twists (translation, rotation) into the frame a pose leads to."""
    # [R, hat(t) R; 0, R]
    rotation = pose[..., :3, :3]
    return np.block(
        [[rotation, se3.hat(pose[..., :3, 3]) @ rotation], [np.zeros_like(rotation), rotation]]
    )


def _inverse_left_jacobian(twist: Array) -> Array:
    """``[..., 6, 6]``, to second order: how the logarithm of a pose follows a twist on its left."""
    # I - ad / 2 + ad^2 / 12, with ad the adjoint of the twist (Baker-Campbell-Hausdorff series)
    by_translation = se3.hat(twist[..., :3])
    by_rotation = se3.hat(twist[..., 3:])
    ad = np.block([[by_rotation, by_translation], [np.zeros_like(by_rotation), by_rotation]])
    return np.asarray(np.eye(6) - ad / 2 + ad @ ad / 12)
