"""ORB-SLAM3 on a whole sequence, as its program `rgbd_tum` does it.

SETTINGS DEPTH_FACTOR SEQUENCE ASSOCIATIONS OUTPUT: its settings file, and raw depth units a metre.

Needs `pip install '.[orbslam3]'` and the vocabulary's path in $DYNSLAM_BENCH_ORB_VOCABULARY.
"""

import os
import sys
from pathlib import Path

import cv2
import pyorbslam3

from dynslam_bench.trackers.adapters.orbslam3 import find_vocabulary


def main(settings: str, depth_factor: str, sequence: str, associations: str, output: str) -> None:
    slam = pyorbslam3.Slam(str(find_vocabulary("")), settings, pyorbslam3.Sensor.RGBD)
    for line in Path(associations).read_text().splitlines():
        stamp, rgb, _, depth = line.split()
        image = cv2.cvtColor(cv2.imread(f"{sequence}/{rgb}"), cv2.COLOR_BGR2RGB)
        units = cv2.imread(f"{sequence}/{depth}", cv2.IMREAD_UNCHANGED)
        metres = units.astype("float32") / float(depth_factor)
        slam.track_rgbd(image, metres, float(stamp))
    slam.shutdown()
    slam.save_trajectory_tum(output)
    sys.stdout.flush()
    os._exit(0)  # its destructors may wait for its threads


main(*sys.argv[1:])
