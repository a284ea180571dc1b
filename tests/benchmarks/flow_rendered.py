"""Pairs of rendered frames with exact flow and the motion model's guess, for the flow measurements."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from flow_data import Pair, corners

from dynslam_bench.geometry import se3
from dynslam_bench.sequences.catalogue import open_sequence

MOTIONS = ("walking_xyz", "walking_halfsphere", "walking_rpy")
HIDDEN_PX = 1.0
MARGIN_PX = 4


def rendered(instance: int, start: int, strides: Sequence[int], count: int, motion: str = "") -> list[Pair]:
    """Pairs ``(start, start + stride)`` of a rendered sequence; truth is the exact flow, also of what moves by itself.

    Points lie on whole pixels. Those that leave the second image or are hidden there (exact flow there and back does
    not return) are left out. The guess is the constant-velocity prediction from the exact poses at ``start - stride``
    and ``start`` with the noisy depth, what a motion model at this frame rate would say; NaN where depth is missing.

    Args:
        instance: 100-199 are held out.
        start: Number of the first frame, at least the largest stride.
        strides: Gaps in frames (30 a second).
        count: Points a frame, before any is left out.
        motion: One of `MOTIONS`; by default the instance's turn.
    """
    motion = motion or MOTIONS[instance % len(MOTIONS)]
    sequence = open_sequence(f"synthetic/{motion}?scene={instance}&frames={start + max(strides) + 1}")
    frame, camera, poses = sequence[start], sequence.camera, sequence.ground_truth.T_world_cam
    gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
    points = np.unique(np.rint(corners(gray, count)), axis=0).astype(np.float32)
    column, row = points.astype(int).T
    pairs = []
    for stride in strides:
        truth = points + sequence.flow(start, start + stride)[row, column]
        inside = ((truth >= MARGIN_PX) & (truth < (camera.width - MARGIN_PX, camera.height - MARGIN_PX))).all(axis=1)
        there = np.where(inside[:, None], truth, 0).astype(np.float32)
        way_back = cv2.remap(sequence.flow(start + stride, start), *there.T[:, None], cv2.INTER_LINEAR)[0]
        with np.errstate(invalid="ignore"):
            seen = inside & (np.hypot(*(truth + way_back - points).T) < HIDDEN_PX)
        kept_up = se3.inverse(poses[start]) @ poses[start - stride]  # T_next_now, as T_now_before was
        z = frame.depth[row, column]
        moved = se3.transform(kept_up, camera.unproject(points, np.maximum(z, 0.1)))
        guess = np.where((z > 0)[:, None] & (moved[:, 2:] > 0.1), camera.project(moved), np.nan).astype(np.float32)
        target = cv2.cvtColor(sequence[start + stride].rgb, cv2.COLOR_RGB2GRAY)
        name = f"{motion}?scene={instance} +{stride}"
        pairs.append(Pair(name, gray, target, points[seen], truth[seen], guess[seen], start))
    return pairs
