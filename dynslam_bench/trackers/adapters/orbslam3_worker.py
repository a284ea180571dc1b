"""The process in which ORB-SLAM3 runs: it isolates its crashes, its `exit()`, its threads and its output."""

import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.trackers.adapters.serve import serve

STATES = {"OK": "ok", "OK_KLT": "ok", "RECENTLY_LOST": "lost", "LOST": "lost"}
"""Tracking states by ORB-SLAM3's; any other is ``initialising``."""


class Worker:
    """One ORB-SLAM3 system; states and poses as its bindings give them."""

    def reset(self, request: dict[str, Any]) -> None:
        """Load the vocabulary and start ORB-SLAM3's threads."""
        try:
            import pyorbslam3
        except ImportError as error:
            raise RuntimeError(
                f"pyorbslam3 cannot be imported: {error}; on Debian and Ubuntu: "
                "apt-get install libgl1 libegl1 libopengl0 libsm6 libice6 libx11-6 libxext6"
            ) from error
        options = request["options"]
        self._monocular = options["sensor"] == "MONOCULAR"
        sensor = getattr(pyorbslam3.Sensor, options["sensor"])
        self._tracked: list[float] = []
        self._final: list[list[float]] | None = None
        self._slam: Any = pyorbslam3.Slam(options["vocabulary"], options["settings_file"], sensor)

    def track(
        self, index: int, timestamp: float, rgb: NDArray[np.uint8], depth: NDArray[np.float32]
    ) -> dict[str, Any]:
        """Track one frame.

        Args:
            index: Number of the frame; ORB-SLAM3 does not need it.
            timestamp: Seconds.
            rgb: uint8 ``[H, W, 3]``.
            depth: float32 ``[H, W]``, metres; unused in monocular mode.

        Returns:
            State, camera-to-world pose as nested lists or None, counts, and seconds by stage.
        """
        if self._final is not None:
            raise RuntimeError(
                "finalize() has stopped ORB-SLAM3's threads: only reset() starts again"
            )
        # track, and time it
        start = time.perf_counter()
        image = np.ascontiguousarray(rgb)
        if self._monocular:
            result = self._slam.track_monocular(image, timestamp)
        else:
            result = self._slam.track_rgbd(image, np.ascontiguousarray(depth), timestamp)
        seconds = time.perf_counter() - start

        # a pose only after the initialisation; a tracked frame without one is lost
        state = STATES.get(result.state.name, "initialising")
        pose = None
        if result.pose_wc is not None and state != "initialising":
            pose = result.pose_wc.astype(float).tolist()
        if state == "ok" and pose is None:
            state = "lost"
        if state == "ok":
            self._tracked.append(timestamp)
        points = float(result.num_tracked_points)
        return {
            "state": state,
            "T_world_cam": pose,
            "stats": {
                "keypoints": float(len(self._slam.tracked_keypoints())),
                "matches": points,
                "inliers": points,
            },
            "timings": {"tracking": seconds},
        }

    def finalize(self) -> list[list[float]]:
        """Stop the threads; the poses of all frames that were tracked, after its last optimisation.

        Its file also holds predicted poses of lost frames, and repeats a stamp where a frame had no
        pose at all.
        """
        if self._final is not None:
            return self._final
        self._slam.shutdown()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "final.txt"
            self._slam.save_trajectory_tum(str(path))
            lines = path.read_text().splitlines()

        # poses of tracked frames; the file rounds the stamps, and the first of a stamp counts
        tracked = {f"{stamp:.6f}": stamp for stamp in self._tracked}
        poses: dict[float, list[float]] = {}
        for line in lines:
            rounded, *pose = (float(value) for value in line.split())
            stamp = tracked.get(f"{rounded:.6f}")
            if stamp is not None and stamp not in poses:
                poses[stamp] = [stamp, *pose]
        self._final = [poses[stamp] for stamp in sorted(poses)]
        return self._final


if __name__ == "__main__":
    worker = Worker()
    serve(worker.reset, worker.track, worker.finalize)
    sys.stderr.flush()
    # without ORB-SLAM3's destructors, which may wait for its threads for ever
    os._exit(0)
