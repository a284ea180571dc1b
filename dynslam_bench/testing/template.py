"""A tracker to start from."""

import re
from pathlib import Path
from string import Template

from dynslam_bench.core import PluginError, write_atomic

_TEMPLATE = Template('''"""$title: a tracker for dynslam-bench.

Check it:  dynslam-bench trackers test ./$file:SPEC
Run it:    dynslam-bench run ./$file:SPEC synthetic/walking_xyz --frames 0:100

To ship it with a package, name the spec in that package's pyproject.toml:

    [project.entry-points."dynslam_bench.trackers"]
    $id = "your_package.$module:SPEC"
"""

import time

import numpy as np

from dynslam_bench.contracts import TrackerSpec, TrackResult
from dynslam_bench.core.settings import Settings, tunable


class ${name}Settings(Settings):
    """Every tunable field is annotated once: from here come validation, --set, and the search space of studies."""

    features: int = tunable(800, low=100, high=2000, scale="log", meaning="corners looked for in a frame")
    threshold_px: float = tunable(
        2.0, low=0.5, high=5.0, scale="log", unit="px", online=True,
        meaning="reprojection error above which a match is an outlier",
    )


class $name:
    """Frame-to-frame visual odometry: corners of the last frame with depth, tracked by Lucas-Kanade, solved as PnP."""

    def __init__(self, settings):
        self.settings = self.built_with = settings

    def configure(self, settings):
        """Other values of the fields marked `online`, in force from the next frame on; `reset` undoes it."""
        self.settings = settings

    def reset(self, camera, *, rng):
        """A new sequence begins; all randomness must come from `rng`."""
        self.settings = self.built_with
        self.camera = camera
        self.rng = rng
        self.last = None
        self.T_world_cam = np.eye(4)  # camera-to-world

    def track(self, frame):
        """One frame: `rgb` uint8 [H, W, 3], `depth` float32 [H, W] in metres with 0 = missing."""
        import cv2

        started = time.perf_counter()
        gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        matches = inliers = 0
        state = "ok" if self.last is None else "lost"
        if self.last is not None:
            last_gray, last_depth = self.last
            corners = cv2.goodFeaturesToTrack(last_gray, self.settings.features, 0.01, 7)
            if corners is not None:
                moved, tracked, _ = cv2.calcOpticalFlowPyrLK(last_gray, gray, corners, None)
                corners, moved = corners.reshape(-1, 2), moved.reshape(-1, 2)
                column, row = np.rint(corners).astype(int).T
                z = last_depth[row.clip(0, gray.shape[0] - 1), column.clip(0, gray.shape[1] - 1)]
                use = (tracked.ravel() == 1) & (z > 0)
                matches = int(use.sum())
                if matches >= 12:
                    points = self.camera.unproject(self.camera.undistort_points(corners[use]), z[use])
                    cv2.setRNGSeed(int(self.rng.integers(2**31)))
                    solved, rotation, translation, good = cv2.solvePnPRansac(
                        points, moved[use].astype(np.float64), self.camera.matrix, np.array(self.camera.distortion),
                        reprojectionError=self.settings.threshold_px,
                    )
                    inliers = 0 if good is None else len(good)
                    if solved and inliers >= 12:
                        T_cam_last = np.eye(4)
                        T_cam_last[:3, :3] = cv2.Rodrigues(rotation)[0]
                        T_cam_last[:3, 3] = translation.ravel()
                        self.T_world_cam = self.T_world_cam @ np.linalg.inv(T_cam_last)
                        state = "ok"
        self.last = gray, frame.depth
        return TrackResult(
            self.T_world_cam.copy(), state,  # a pose given while lost counts as a prediction
            stats={"matches": float(matches), "inliers": float(inliers)},  # the same keys on every frame
            timings={"track": time.perf_counter() - started},
        )


SPEC = TrackerSpec(
    id="$id",
    entry_point=f"{__file__}:$name",
    label="$title",
    settings=${name}Settings,
    summary="frame-to-frame PnP on tracked corners",
    license="MIT",
)
''')


def write_tracker_template(name: str, folder: Path | str = ".") -> Path:
    """Write one file with a small tracker that runs and passes the conformance checks.

    Args:
        name: Name of the tracker, e.g. ``my-slam``.
        folder: Where to put it.

    Returns:
        The file.

    Raises:
        PluginError: The name is no name, or the file exists.
        DynslamError: The folder cannot be written.
    """
    words = re.findall(r"[A-Za-z0-9]+", name)
    if (
        not words
        or not words[0][0].isalpha()
        or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9 _.-]*", name)
    ):
        raise PluginError(
            f"'{name}' is no name for a tracker", "letters, digits and hyphens, e.g. my-slam"
        )
    identifier = "-".join(words).lower()
    module = "_".join(words).lower()
    path = Path(folder).expanduser() / f"{module}.py"
    if path.exists():
        raise PluginError(f"{path} exists already", "choose another name or folder")
    text = _TEMPLATE.substitute(
        title=" ".join(word if word.isupper() else word.capitalize() for word in words),
        file=path.name,
        module=module,
        id=identifier,
        name="".join(word[0].upper() + word[1:] for word in words),
    )
    write_atomic(path, text)
    return path
