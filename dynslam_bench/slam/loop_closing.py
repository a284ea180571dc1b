"""Loop closing, the last row of the paper's Figure 2: verify_place a place, verify it, correct the map, fuse it.

1. *Detect*: keyframes that share few points with the newest one, and are old, are ranked by how much they look like
   it (`places`: nothing is trained or downloaded). Those that do so no less than its neighbours do, the best few of
   them, are matched feature by feature.
2. *Verify*: a pose by RANSAC, then by all points around the candidate, and without depth the scale. It must explain
   most of what should be in view, agree with the keyframes before, and ask for no more correction than the way since
   the candidate may have drifted. The last condition is ours: rooms that look the same pass all others.
3. *Correct*: a pose graph over all keyframes: neighbours, those that share many points, all loops. Without depth the
   scale drifts as well: each keyframe's scale is found first, then the poses. A map of its own, begun after the camera
   was lost where nothing was recognised, is moved to where it belongs instead, as it is.
4. *Fuse*: points of both visits that are one thing in the world are merged, and the surroundings are adjusted.

Lengths are metres; without depth they are in units of the first map's median depth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.seeding import stream
from dynslam_bench.geometry import se3
from dynslam_bench.slam.atlas import Atlas
from dynslam_bench.slam.local_mapping import LocalMapper
from dynslam_bench.slam.map import Map
from dynslam_bench.slam.map_kernels import distinct
from dynslam_bench.slam.observation import Observations
from dynslam_bench.slam.place_recognition import (
    PlaceHypothesis,
    PlaceMatch,
    ambiguous,
    around,
    match_keyframe,
    points_around,
    pose_uncertainty,
    ransac_pose,
    recognition_scores,
    verify_place,
)
from dynslam_bench.slam.pose_graph import Edge, inherited, optimise_poses, rescaled, spread_scale, within
from dynslam_bench.slam.relocalisation import InitialPose
from dynslam_bench.slam.settings import BackendSettings
from dynslam_bench.slam.tracking import Matches, weakly_connected

Array = NDArray[np.float64]
Slots = NDArray[np.int64]

STRONG = 100
"""Keyframes that share so many points are tied in the pose graph (ORB-SLAM2's number)."""
SLACK_M, SLACK_DEG = 0.1, 3.0
"""Correction that is believed however short the way."""
TURN_M = 3.0
"""Metres of way that a turn by one radian counts as: it renews the view as much as walking past a wall 3 m away."""
TURN_DEPTHS = 1.0
"""The same without depth: the wall is as far away as what the first map showed."""
STRETCH = 100.0
"""Way along which drift adds up; of a longer one each such stretch drifts by itself, so that the root of it counts."""
NEGLIGIBLE_M, NEGLIGIBLE_DEG, NEGLIGIBLE_SCALE = 0.01, 0.3, 0.01
"""A smaller correction is left to fusion and bundle adjustment; of a scale, its logarithm."""
MOST_SCALE = 3.0
"""Factor by which scale may have drifted, at most, where it is free."""
FIRM = 100.0
"""Weight of a loop's tie, where neighbours' ties weigh 1: what it leaves open between two visits bends both."""
PATIENCE = 5
"""Frames after which a camera leaves an submap for the first map, if that could not be joined by then."""
FIRMLY = 0.4
"""So imprecise, at most, is a pose by which maps are joined (`localisation.recognition`)."""
SCALE_POINTS = 20
"""So many features with a point of both visits are needed to tell the scale."""


class LoopCloser:
    """Looks for loops at every new keyframe, and closes them.

    Args:
        world: The map.
        mapper: Fuses and adjusts.
        submaps: Where parts of the map may lie that are connected with the first one by nothing.
        settings: Of the back end.
        seed: Founds RANSAC's draws.
        scale_is_known: Whether lengths are metres everywhere, as with depth.
    """

    def __init__(
        self,
        world: Map,
        mapper: LocalMapper,
        submaps: Atlas,
        settings: BackendSettings,
        seed: int,
        *,
        scale_is_known: bool = True,
    ) -> None:
        self.world = world
        self.mapper = mapper
        self.submaps = submaps
        self.settings = settings
        self.closed: list[Loop] = []
        """All loops that were closed."""
        self.rescaled: dict[int, float] = {}
        """By what the last call of `close` rescaled the surroundings of keyframes, by their slots; with depth by 1, and
        of those alone that it moved to another map."""
        self.in_root_map = self.leaves = False
        """Whether an submap's camera was in the first map by the last call of `close`, and is to go on there."""
        self._seed = seed
        self._scale_is_known = scale_is_known
        self._way: dict[int, float] = {}
        self._walked = 0.0
        self._short_cuts: list[tuple[float, float]] = []
        self._last_pose: Array | None = None
        self._row: list[Correction] = []
        self._met: int | None = None
        self._ties: list[Edge] = []

    def close(self, slot: int, seen: Observations, home: InitialPose | None = None) -> bool:
        """Look for a loop at a new keyframe; correct and fuse the map if enough keyframes in a row agree on one.

        Args:
            slot: The keyframe.
            seen: Its features.
            home: Its pose in the first map, if the camera is on an submap and was found there.

        Returns:
            Whether a loop was closed; every pose and point may have changed then.
        """
        self.rescaled, self.in_root_map, self.leaves = {}, False, False
        self._note_way(slot)
        for dropped, heir, relative in self.mapper.dropped if self._ties else ():
            gone, stands = (int(self.world.kf_id[each]) for each in (dropped, heir))
            self._ties = inherited(self._ties, gone, stands, relative)
        loop = self._verified(slot, seen) if home is None else self._in_root_map(slot, seen, home)
        self._met = self._met if self.in_root_map else None
        if loop is None:
            self._row.clear()
            return False
        correction = Correction(self.world.kf_pose[slot].copy(), loop.T_cam_world, loop.scale)
        if self._row and not correction.agrees(self._row[-1], self.world.kf_centre[slot]):
            self._row.clear()
        self._row.append(correction)
        if len(self._row) < self.settings.loop_closing.confirmations:
            return False
        loop = replace(loop, scale=float(np.median([each.scale for each in self._row])))
        self._row.clear()
        if not loop.fits:
            self.leaves = self.in_root_map = home is not None
            return False
        if loop.joins and home is None and self._ambiguous(slot, seen, loop):
            return False
        if loop.joins:
            self._join(slot, loop)
        else:
            self._correct(slot, loop)
        self._fuse(slot, loop.keyframe)
        self._short_cuts.append((self._way_at(loop.keyframe), self._walked))
        self.closed.append(loop)
        self._last_pose = self.world.kf_pose[slot].copy()  # a correction is no way
        return True

    # ------------------------------------------------------------------ detect and verify

    def _note_way(self, slot: int) -> None:
        pose, number = self.world.kf_pose[slot].copy(), int(self.world.kf_id[slot])
        for begun in range(next(reversed(self._way), number - 1) + 1, number):  # the first two views of an submap
            self._way[begun] = self._walked
        if self._last_pose is not None:
            step = pose @ se3.inverse(self._last_pose)
            turn = TURN_M if self._scale_is_known else TURN_DEPTHS
            self._walked += float(np.linalg.norm(step[:3, 3]) + turn * se3.rotation_angle(step))
        self._last_pose = pose
        self._way[number] = self._walked

    def _verified(self, slot: int, seen: Observations) -> Loop | None:
        s = self.settings.loop_closing
        elsewhere = weakly_connected(self.world, slot, s.away)
        there, here = self.world.kf_map[elsewhere], self.world.kf_map[slot]
        elsewhere = elsewhere[(there == here) | (there == 0) | (here == 0)]
        if not len(elsewhere):
            return None
        rng = stream(self._seed, "loop", int(self.world.kf_id[slot]))
        for candidate in self._as_alike_as_neighbours(slot, elsewhere, seen):
            matches = match_keyframe(self.world, candidate, seen, self.settings.relocalisation.max_distance)
            if len(matches) < s.min_matches:
                continue
            loop = self._by_points_around(slot, candidate, seen, matches, rng)
            if loop is not None:
                return loop
        return None

    def _as_alike_as_neighbours(self, slot: int, elsewhere: Slots, seen: Observations) -> list[int]:
        near = np.setdiff1d(around(self.world, slot)[1:], elsewhere)  # what is to be recognised is no measure of it
        score = recognition_scores(self.world, np.concatenate([near, elsewhere]), seen)
        least = score[: len(near)].min(initial=np.inf)
        there = score[len(near) :]
        best = np.argsort(-there, kind="stable")[: self.settings.loop_closing.candidates]
        return [int(elsewhere[row]) for row in best if there[row] >= least]

    def _by_points_around(
        self, slot: int, candidate: int, seen: Observations, matches: Matches, rng: np.random.Generator
    ) -> Loop | None:
        """The pose by all points around a candidate, if it explains enough and is not too far to be drift."""
        world, s = self.world, self.settings.loop_closing
        f = matches.feature
        iterations = self.settings.relocalisation.iterations
        found = ransac_pose(matches.position, seen.xy[f], seen.info[f], world.camera, iterations, rng)
        if found is None or np.count_nonzero(found[1]) < s.min_matches // 2:
            return None
        pose, inliers = found
        place = verify_place(world, candidate, seen, matches.select(inliers), pose, self.settings.tracking)
        if len(place.matches) < s.min_inliers or place.share < s.min_share:
            return None
        loop = self._loop(slot, candidate, place)
        if loop is None or (loop.joins and pose_uncertainty(world, seen, place, rng) > FIRMLY):
            return None
        return loop if self._believable(slot, loop) else None

    def _in_root_map(self, slot: int, seen: Observations, home: InitialPose) -> Loop | None:
        """The place in the first map where an submap's camera was found, if it tells well enough how the two lie."""
        s, world, frame = self.settings.loop_closing, self.world, int(self.world.kf_frame[slot])
        loop = self._loop(slot, home.keyframe, PlaceMatch(home.T_cam_world, home.matches, home.share))
        if loop is None or not world.kf_alive[home.keyframe]:
            return None
        if (loop.fits or self._scale_is_known) and self._ambiguous(slot, seen, loop):
            return None
        well = loop.inliers >= s.min_inliers and loop.share >= s.merge_share and home.pose_uncertainty <= FIRMLY
        self.in_root_map = loop.fits
        self._met = frame if self._met is None else self._met
        self.leaves = self.in_root_map and not well and frame - self._met >= PATIENCE
        return loop if well else None

    def _loop(self, slot: int, candidate: int, place: PlaceMatch) -> Loop | None:
        """What a place asks for; None where too little tells the scale."""
        world = self.world
        scale = 1.0 if self._scale_is_known else self._scale(slot, place)
        if scale is None:
            return None
        T_cam_world = place.T_cam_world
        moved = float(np.linalg.norm(se3.inverse(T_cam_world)[:3, 3] - world.kf_centre[slot]))
        turned = float(np.degrees(se3.rotation_angle(T_cam_world @ se3.inverse(world.kf_pose[slot]))))
        back, joins = int(world.kf_frame[candidate]), bool(world.kf_map[candidate] != world.kf_map[slot])
        loop = Loop(candidate, back, T_cam_world, len(place.matches), place.share, joins, moved, turned, scale)
        return replace(loop, fits=self._fits(slot, loop)) if joins else loop

    def _scale(self, slot: int, place: PlaceMatch) -> float | None:
        """How many times as deep points lie by the first visit as by this one; None where too few tell."""
        world, theirs = self.world, place.matches
        own = world.kf_point[slot, theirs.feature].astype(np.int64)
        both = (own >= 0) & (own != theirs.point)
        if np.count_nonzero(both) < SCALE_POINTS:
            return None
        then = se3.transform(place.T_cam_world, world.position[theirs.point[both]])[:, 2]
        now = se3.transform(world.kf_pose[slot], world.position[own[both]])[:, 2]
        ahead = (then > 0) & (now > 0)
        return float(np.exp(np.median(np.log(then[ahead] / now[ahead])))) if ahead.sum() >= SCALE_POINTS else None

    def _believable(self, slot: int, loop: Loop) -> bool:
        """Whether drift explains the correction; where submaps meet, whether the camera can have got from one there."""
        s = self.settings.loop_closing
        if loop.joins and (loop.inliers < s.merge_inliers or loop.share < s.merge_share):
            return False
        if loop.joins:
            here, there = (int(self.world.kf_map[each]) for each in (slot, loop.keyframe))
            return loop.fits and bool(np.radians(loop.turned_deg) <= self.submaps.slack(here, there))
        way = self._way_to(loop.keyframe)
        if not 1 / MOST_SCALE < loop.scale < MOST_SCALE:
            return False
        return loop.moved_m <= SLACK_M + s.drift_share * way and loop.turned_deg <= SLACK_DEG + s.drift_deg * way

    def _fits(self, slot: int, loop: Loop) -> bool:
        """Whether the younger of two submaps can have begun where the older one would have it."""
        younger, _, move = self._moves(slot, loop)
        share = 0.0 if self._scale_is_known else self.settings.loop_closing.drift_share
        return self.submaps.admits_start(younger, move.moved, share * self._way_around(slot, loop))

    def _ambiguous(self, slot: int, seen: Observations, loop: Loop) -> bool:
        """Whether the keyframe looks like two places: nothing but what is seen tells how submaps lie together."""
        world = self.world
        here, there = (int(world.kf_map[each]) for each in (slot, loop.keyframe))
        own = world.kf_point[slot, world.kf_point[slot] >= 0]
        depth = float(np.median(se3.transform(world.kf_pose[slot], world.position[own])[:, 2]))
        known = {here: PlaceHypothesis(world.kf_pose[slot], loop.share, depth)}
        known[there] = PlaceHypothesis(loop.T_cam_world, loop.share, depth * loop.scale)
        elsewhere = weakly_connected(world, slot, self.settings.loop_closing.away)
        return ambiguous(world, seen, known, elsewhere, self.settings, self._seed)

    def _way_to(self, slot: int) -> float:
        """The way whose drift adds up since a keyframe: walked and turned, or over a closed loop."""
        then = self._way_at(slot)
        way = min([self._walked - then, *(abs(then - old) + self._walked - new for old, new in self._short_cuts)])
        return min(way, float(np.sqrt(STRETCH * way)))

    def _way_around(self, slot: int, loop: Loop) -> float:
        """The way from where one submap meets another back to where it left it, in the older one's unit of length."""
        younger, _, move = self._moves(slot, loop)
        left = self._way_at(int(self.world.submap(younger)[0]))
        ends = (slot, loop.keyframe) if self.world.kf_map[slot] == younger else (loop.keyframe, slot)
        on_younger, on_older = (abs(self._way_at(each) - left) for each in ends)
        return move.scale * on_younger + on_older

    def _way_at(self, slot: int) -> float:
        """The way up to a keyframe; none up to those of a loaded map."""
        return self._way.get(int(self.world.kf_id[slot]), 0.0)

    # ------------------------------------------------------------------ correct and fuse

    def _correct(self, slot: int, loop: Loop) -> None:
        """Spread the correction over all keyframes; each point moves with the first keyframe that observes it."""
        world = self.world
        tie = replace(self._edge(loop.keyframe, slot, loop.T_cam_world), weight=FIRM)
        older = within(world.kf_id[world.keyframes], self._ties)
        self._ties = [*older, tie]
        small = loop.moved_m < NEGLIGIBLE_M and loop.turned_deg < NEGLIGIBLE_DEG
        if small and abs(np.log(loop.scale)) < NEGLIGIBLE_SCALE:
            return
        slots = world.submap(int(world.kf_map[slot]))
        before, ids = world.kf_pose.copy(), world.kf_id[slots]
        edges, scales = self._edges(slots), np.ones(world.kf_alive.size)
        if not self._scale_is_known:
            scales[slots] = spread_scale(ids, [*edges, *within(ids, older)], tie, loop.scale)
            edges = rescaled(edges, ids, scales[slots])
            self._note_scales(slots, scales[slots])
        after = optimise_poses(ids, before[slots], [*edges, *within(ids, self._ties)])
        for at, pose in zip(slots.tolist(), after, strict=True):
            world.set_pose(at, pose)
        self.submaps.carried(int(world.kf_map[slot]), before[slots], after, scales[slots])
        points = distinct(world.kf_point[slots], world.alive.size)
        reference = world.obs_kf[world.obs_at[points]]
        local = np.einsum("nij,nj->ni", before[reference, :3, :3], world.position[points]) + before[reference, :3, 3]
        local *= scales[reference, None]
        now = se3.inverse(world.kf_pose[reference])
        world.position[points] = np.einsum("nij,nj->ni", now[:, :3, :3], local) + now[:, :3, 3]
        world.refresh(points)

    def _moves(self, slot: int, loop: Loop) -> tuple[int, int, Correction]:
        """The younger of two submaps that meet, the older one, and how the younger is to be moved."""
        here, there = (int(self.world.kf_map[each]) for each in (slot, loop.keyframe))
        move = Correction(self.world.kf_pose[slot].copy(), loop.T_cam_world, loop.scale)
        return (here, there, move) if here > there else (there, here, move.inverse)

    def _join(self, slot: int, loop: Loop) -> None:
        """Move the younger of two submaps as a whole to where the older one has the place."""
        world = self.world
        younger, older, move = self._moves(slot, loop)
        slots = world.submap(younger)
        world.move_submap(younger, move.T_now_before, older, move.scale)
        self._note_scales(slots, np.full(len(slots), move.scale))
        self._ties.append(replace(self._edge(loop.keyframe, slot, world.kf_pose[slot]), weight=FIRM))

    def _note_scales(self, slots: Slots, scales: Array) -> None:
        """Lengths around keyframes were multiplied."""
        self._ties = rescaled(self._ties, self.world.kf_id[slots], scales)
        self.rescaled = dict(zip(slots.tolist(), scales.tolist(), strict=True))

    def _edge(self, one: int, other: int, pose_of_other: Array) -> Edge:
        world = self.world
        relative = pose_of_other @ se3.inverse(world.kf_pose[one])
        return Edge(int(world.kf_id[one]), int(world.kf_id[other]), relative)

    def _edges(self, slots: Slots) -> list[Edge]:
        """Ties between keyframes as the map is now: each with the older ones that share many points, and the most.

        Neighbours in time that share nothing are not tied: the camera was lost between them.
        """
        pairs = set()
        for slot in slots.tolist():
            near, shared = self.world.covisible(slot)
            older = self.world.kf_id[near] < self.world.kf_id[slot]
            near, shared = near[older], shared[older]
            pairs |= {(int(other), slot) for other in [*near[:1], *near[shared >= STRONG]]}
        return [self._edge(a, b, self.world.kf_pose[b]) for a, b in sorted(pairs)]

    def _fuse(self, slot: int, candidate: int) -> None:
        theirs = points_around(self.world, candidate)
        for keyframe in around(self.world, slot).tolist():
            self.mapper.fuse_into(keyframe, theirs[self.world.alive[theirs]])
        self.world.refresh(theirs[self.world.alive[theirs]])
        if self.settings.bundle_adjustment.enabled:
            self.mapper.adjust(slot)


# What a keyframe that sees a place again asks for: to be elsewhere, and without depth of another size.


AGREE_M, AGREE_DEG, AGREE_SCALE = 0.1, 2.0, 0.1
"""So far the corrections of keyframes in a row may differ; of a scale, its logarithm."""


@dataclass(frozen=True, eq=False)
class Correction:
    """What a keyframe asks for.

    Attributes:
        T_cam_before: Its pose ``[4, 4]`` as the map has it, world to camera.
        T_cam_now: Its pose by the place that it sees again.
        scale: What lengths around it are to be multiplied by.
    """

    T_cam_before: Array
    T_cam_now: Array
    scale: float

    @property
    def T_now_before(self) -> Array:
        """From the keyframe's world, once its lengths are multiplied, to that of the place, ``[4, 4]``."""
        before = self.T_cam_before.copy()
        before[:3, 3] *= self.scale
        return se3.inverse(self.T_cam_now) @ before

    @property
    def inverse(self) -> Correction:
        """What the place asks for where it is the keyframe that stays."""
        return Correction(self.T_cam_now, self.T_cam_before, 1 / self.scale)

    def moved(self, at: Array) -> Array:
        """Where a place ``[3]`` near the keyframe belongs, ``[3]``."""
        local = self.scale * se3.transform(self.T_cam_before, at[None])
        return np.asarray(se3.transform(se3.inverse(self.T_cam_now), local)[0])

    def agrees(self, other: Correction, at: Array) -> bool:
        """Whether another correction moves a place nearly as this one does."""
        apart = np.linalg.norm(self.moved(at) - other.moved(at))
        turned = se3.rotation_angle(self.T_now_before @ se3.inverse(other.T_now_before))
        scaled = abs(np.log(self.scale / other.scale))
        return bool(apart < AGREE_M and np.degrees(turned) < AGREE_DEG and scaled < AGREE_SCALE)


@dataclass(frozen=True)
class Loop:
    """A place that was recognised.

    Attributes:
        keyframe: Slot, at that time, of the keyframe that was seen again.
        frame: Index of that keyframe's frame.
        T_cam_world: Pose ``[4, 4]`` of the newest keyframe by the points around it, world to camera.
        inliers: Points that fit it.
        share: How many of the keyframe's own points in view are among them, of one.
        joins: Whether the place lies on another submap of the map.
        moved_m: How far the newest keyframe is from where it was believed to be.
        turned_deg: By how much it is turned, degrees.
        scale: What lengths around the newest keyframe are to be multiplied by; 1 with depth.
        fits: Whether the submap could come to lie so; without depth its lengths may have drifted apart on the way.
    """

    keyframe: int
    frame: int
    T_cam_world: Array
    inliers: int
    share: float
    joins: bool
    moved_m: float
    turned_deg: float
    scale: float
    fits: bool = True
