"""SVO on a whole sequence: CAMERA SEQUENCE ASSOCIATIONS OUTPUT."""

import sys
from pathlib import Path

import cv2
import numpy as np

from dynslam_bench.geometry import Trajectory, write_tum
from dynslam_bench.trackers.adapters.svo import Worker


def main(camera: str, sequence: str, associations: str, output: str) -> None:
    settings = cv2.FileStorage(camera, cv2.FILE_STORAGE_READ)
    worker = Worker()
    numbers = {
        name: settings.getNode(f"Camera1.{name}").real() for name in ("fx", "fy", "cx", "cy")
    }
    distortion = [
        settings.getNode(f"Camera1.{name}").real() for name in ("k1", "k2", "p1", "p2", "k3")
    ]
    size = {name: int(settings.getNode(f"Camera.{name}").real()) for name in ("width", "height")}
    worker.reset({"camera": size | numbers | {"distortion": distortion}, "options": {}})
    stamps = []
    poses = []
    for index, line in enumerate(Path(associations).read_text().splitlines()):
        stamp, rgb = line.split()[:2]
        image = cv2.cvtColor(cv2.imread(f"{sequence}/{rgb}"), cv2.COLOR_BGR2RGB)
        answer = worker.track(index, float(stamp), image, np.empty(0, np.float32))
        if answer["state"] == "ok":
            stamps.append(float(stamp))
            poses.append(answer["T_world_cam"])
    write_tum(output, Trajectory(np.array(stamps), np.array(poses).reshape(-1, 4, 4)))


main(*sys.argv[1:])
