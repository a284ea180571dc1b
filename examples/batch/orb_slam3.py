"""ORB-SLAM3 on a whole sequence, as its program `rgbd_tum` does it: CAMERA SEQUENCE ASSOCIATIONS OUTPUT.

Needs `pip install '.[orbslam3]'` and the vocabulary's path in $DYNSLAM_BENCH_ORB_VOCABULARY.
"""

import os
import sys
from pathlib import Path

import cv2
import pyorbslam3

from dynslam_bench.trackers.adapters.orbslam3 import find_vocabulary


def main(camera: str, sequence: str, associations: str, output: str) -> None:
    settings = cv2.FileStorage(camera, cv2.FILE_STORAGE_READ)
    factor = settings.getNode("DepthMapFactor").real()
    own = Path("camera.yaml")  # the bindings take depth in metres
    text = Path(camera).read_text()
    own.write_text(text.replace(f"RGBD.DepthMapFactor: {factor}", "RGBD.DepthMapFactor: 1.0"))
    slam = pyorbslam3.Slam(str(find_vocabulary("")), str(own), pyorbslam3.Sensor.RGBD)
    for line in Path(associations).read_text().splitlines():
        stamp, rgb, _, depth = line.split()
        image = cv2.cvtColor(cv2.imread(f"{sequence}/{rgb}"), cv2.COLOR_BGR2RGB)
        metres = cv2.imread(f"{sequence}/{depth}", cv2.IMREAD_UNCHANGED).astype("float32") / factor
        slam.track_rgbd(image, metres, float(stamp))
    slam.shutdown()
    slam.save_trajectory_tum(output)
    sys.stdout.flush()
    os._exit(0)  # its destructors may wait for its threads


main(*sys.argv[1:])
