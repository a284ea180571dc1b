"""Loop closing, the last row of the paper's Figure 2: recognise a place, verify it, correct the map, fuse it.

1. *Detect*: keyframes that share no point with the newest one nor with its neighbours, and are old, are ranked by how
   much they look like it (`places`: nothing is trained or downloaded). Those that do so no less than its neighbours do,
   the best few of them, are matched feature by feature.
2. *Verify*: a pose by RANSAC, then by all points around the candidate, in metres since depth is known. It must explain
   most of what should be in view, agree with the keyframes before, and ask for no more correction than the way since
   the candidate may have drifted. The last condition is ours: rooms that look the same pass all others.
3. *Correct*: a pose graph over all keyframes: neighbours in time, those that share many points, all loops.
4. *Fuse*: points of both visits that are one thing in the world are merged, and the surroundings are adjusted.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.seeding import stream
from dynslam_bench.geometry import se3

from .bundle.pose_graph import Edge, optimise_poses
from .localisation.observation import Observations
from .localisation.relocalisation import match_keyframe, ransac_pose
from .localisation.surroundings import apart
from .localisation.tracking import Matches, match_map, solve
from .mapping.local_mapping import LocalMapper
from .mapping.map import Map
from .places import likeness
from .settings import BackendSettings

Array = NDArray[np.float64]
Slots = NDArray[np.int64]

AROUND = 10
"""Keyframes around each end of a loop whose points are looked for and fused."""
STRONG = 100
"""Keyframes that share so many points are tied in the pose graph (ORB-SLAM2's number)."""
SLACK_M, SLACK_DEG = 0.1, 3.0
"""Correction that is believed however short the way."""
AGREE_M, AGREE_DEG = 0.1, 2.0
"""So far the corrections of keyframes in a row may differ."""
NEGLIGIBLE_M, NEGLIGIBLE_DEG = 0.01, 0.3
"""A smaller correction is left to fusion and bundle adjustment."""


@dataclass(frozen=True)
class Loop:
    """A place that was recognised.

    Attributes:
        keyframe: Slot, at that time, of the keyframe that was seen again.
        frame: Index of that keyframe's frame.
        T_cam_world: Pose ``[4, 4]`` of the newest keyframe by the points around it, world to camera.
        inliers: Points that fit it.
        moved_m: How far the newest keyframe is from where it was believed to be, metres.
        turned_deg: By how much it is turned, degrees.
    """

    keyframe: int
    frame: int
    T_cam_world: Array
    inliers: int
    moved_m: float
    turned_deg: float


class LoopCloser:
    """Looks for loops at every new keyframe, and closes them.

    Args:
        world: The map.
        mapper: Fuses and adjusts.
        settings: Of the back end.
        seed: Founds RANSAC's draws.
    """

    def __init__(self, world: Map, mapper: LocalMapper, settings: BackendSettings, seed: int) -> None:
        self.world = world
        self.mapper = mapper
        self.settings = settings
        self.closed: list[Loop] = []
        """All loops that were closed."""
        self._seed = seed
        self._way: dict[int, float] = {}
        self._walked = 0.0
        self._last_centre: Array | None = None
        self._row: list[Array] = []
        self._ties: list[Edge] = []

    def close(self, slot: int, seen: Observations) -> bool:
        """Look for a loop at a new keyframe; correct and fuse the map if enough keyframes in a row agree on one.

        Args:
            slot: The keyframe.
            seen: Its features.

        Returns:
            Whether a loop was closed; every pose and point may have changed then.
        """
        self._note_way(slot)
        loop = self._verified(slot, seen)
        if loop is None:
            self._row.clear()
            return False
        correction = se3.inverse(loop.T_cam_world) @ self.world.kf_pose[slot]
        if self._row and not _near(self._row[-1], correction, self.world.kf_centre[slot]):
            self._row.clear()
        self._row.append(correction)
        if len(self._row) < self.settings.loop_closing.confirmations:
            return False
        self._row.clear()
        self._correct(slot, loop)
        self._fuse(slot, loop.keyframe)
        self.closed.append(loop)
        return True

    # ------------------------------------------------------------------ detect and verify

    def _note_way(self, slot: int) -> None:
        centre = self.world.kf_centre[slot]
        if self._last_centre is not None:
            self._walked += float(np.linalg.norm(centre - self._last_centre))
        self._last_centre = centre.copy()
        self._way[int(self.world.kf_id[slot])] = self._walked

    def _verified(self, slot: int, seen: Observations) -> Loop | None:
        s = self.settings.loop_closing
        elsewhere = apart(self.world, slot, s.away)
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
        near = self._around(slot)[1:]
        score = likeness(self.world, np.concatenate([near, elsewhere]), seen)
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
        known = matches.select(inliers)
        estimate = solve(world, seen, known, pose)
        more, _ = match_map(
            world, seen, estimate.T_cam_world, known, self._points_around(candidate), self.settings.tracking, widen=2.0
        )
        joined = known.joined(more)
        estimate = solve(world, seen, joined, estimate.T_cam_world)
        if estimate.count < s.min_inliers or not np.isfinite(estimate.T_cam_world).all():
            return None
        own = world.kf_point[candidate]
        in_view, *_ = world.project(estimate.T_cam_world, own[own >= 0].astype(np.int64))
        hit = np.isin(in_view, joined.point[estimate.inliers])
        moved = np.linalg.inv(estimate.T_cam_world)[:3, 3] - world.kf_centre[slot]
        turned = float(np.degrees(se3.rotation_angle(estimate.T_cam_world @ se3.inverse(world.kf_pose[slot]))))
        back = int(world.kf_frame[candidate])
        loop = Loop(candidate, back, estimate.T_cam_world, estimate.count, float(np.linalg.norm(moved)), turned)
        share = np.count_nonzero(hit) / max(len(in_view), 1)
        return loop if share >= s.min_share and self._may_be_drift(loop) else None

    def _may_be_drift(self, loop: Loop) -> bool:
        s = self.settings.loop_closing
        way = self._walked - self._way[int(self.world.kf_id[loop.keyframe])]
        return loop.moved_m <= SLACK_M + s.drift_share * way and loop.turned_deg <= SLACK_DEG + s.drift_deg * way

    def _around(self, keyframe: int) -> Slots:
        near, _ = self.world.covisible(keyframe)
        return np.concatenate([[keyframe], near[:AROUND]]).astype(np.int64)

    def _points_around(self, keyframe: int) -> Slots:
        table = self.world.kf_point[self._around(keyframe)]
        return np.unique(table[table >= 0]).astype(np.int64)

    # ------------------------------------------------------------------ correct and fuse

    def _correct(self, slot: int, loop: Loop) -> None:
        """Spread the correction over all keyframes; each point moves with the first keyframe that observes it."""
        world = self.world
        tie = self._edge(loop.keyframe, slot, loop.T_cam_world)
        self._ties = [edge for edge in self._ties if self._alive(edge)] + [tie]
        if loop.moved_m < NEGLIGIBLE_M and loop.turned_deg < NEGLIGIBLE_DEG:
            return
        slots = world.keyframes
        before = world.kf_pose.copy()
        after = optimise_poses(world.kf_id[slots], before[slots], [*self._edges(slots), *self._ties])
        for at, pose in zip(slots.tolist(), after, strict=True):
            world.set_pose(at, pose)
        points = world.points[world.n_obs[world.points] > 0]
        reference = world.obs_kf[points, 0]
        local = np.einsum("nij,nj->ni", before[reference, :3, :3], world.position[points]) + before[reference, :3, 3]
        now = se3.inverse(world.kf_pose[reference])
        world.position[points] = np.einsum("nij,nj->ni", now[:, :3, :3], local) + now[:, :3, 3]
        world.refresh(points)

    def _edge(self, one: int, other: int, pose_of_other: Array) -> Edge:
        world = self.world
        relative = pose_of_other @ se3.inverse(world.kf_pose[one])
        return Edge(int(world.kf_id[one]), int(world.kf_id[other]), relative)

    def _alive(self, edge: Edge) -> bool:
        ids = self.world.kf_id[self.world.keyframes]
        return bool(np.isin([edge.one, edge.other], ids).all())

    def _edges(self, slots: Slots) -> list[Edge]:
        """Ties between keyframes as the map is now: neighbours in time, and those that share many points."""
        pairs = set(pairwise(slots.tolist()))
        for slot in slots.tolist():
            near, shared = self.world.covisible(slot)
            strong = near[shared >= STRONG]
            pairs |= {(int(other), slot) for other in strong if self.world.kf_id[other] < self.world.kf_id[slot]}
        return [self._edge(a, b, self.world.kf_pose[b]) for a, b in sorted(pairs)]

    def _fuse(self, slot: int, candidate: int) -> None:
        theirs = self._points_around(candidate)
        for keyframe in self._around(slot).tolist():
            self.mapper.fuse_into(keyframe, theirs[self.world.alive[theirs]])
        self.world.refresh(theirs[self.world.alive[theirs]])
        if self.settings.bundle_adjustment.enabled:
            self.mapper.adjust(slot)


def _near(one: Array, other: Array, at: Array) -> bool:
    """Whether two corrections of the world agree at a place."""
    apart = np.linalg.norm(se3.transform(one, at[None]) - se3.transform(other, at[None]))
    return bool(apart < AGREE_M and np.degrees(se3.rotation_angle(one @ se3.inverse(other))) < AGREE_DEG)
