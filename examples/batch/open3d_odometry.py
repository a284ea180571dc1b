"""Open3D's dense RGB-D odometry on a whole sequence: CAMERA SEQUENCE ASSOCIATIONS OUTPUT."""

import sys
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d

from dynslam_bench.geometry import Trajectory, write_tum


def main(camera: str, sequence: str, associations: str, output: str) -> None:
    settings = cv2.FileStorage(camera, cv2.FILE_STORAGE_READ)
    number = {name: settings.getNode(f"Camera1.{name}").real() for name in ("fx", "fy", "cx", "cy")}
    matrix = np.array([[number["fx"], 0, number["cx"]], [0, number["fy"], number["cy"]], [0, 0, 1]])
    distortion = np.array(
        [settings.getNode(f"Camera1.{name}").real() for name in ("k1", "k2", "p1", "p2", "k3")]
    )
    width, height = (int(settings.getNode(f"Camera.{name}").real()) for name in ("width", "height"))
    maps = cv2.initUndistortRectifyMap(
        matrix, distortion, np.eye(3), matrix, (width, height), cv2.CV_32FC1
    )
    factor = settings.getNode("DepthMapFactor").real()
    intrinsics = o3d.core.Tensor(matrix)

    # the last image, and the pose that the motions since the first one add up to
    last = None
    pose = np.eye(4)
    stamps = []
    poses = []
    for line in Path(associations).read_text().splitlines():
        # undistort both images; depth without interpolation
        stamp, rgb, _, depth = line.split()
        colour = cv2.remap(cv2.imread(f"{sequence}/{rgb}"), *maps, cv2.INTER_LINEAR)
        raw = cv2.remap(
            cv2.imread(f"{sequence}/{depth}", cv2.IMREAD_UNCHANGED), *maps, cv2.INTER_NEAREST
        )
        image = o3d.t.geometry.RGBDImage(
            *(o3d.t.geometry.Image(o3d.core.Tensor(part)) for part in (colour, raw))
        )
        try:
            if last is not None:
                motion = o3d.t.pipelines.odometry.rgbd_odometry_multi_scale(
                    image, last, intrinsics, depth_scale=factor, depth_max=8.0
                )
                pose = pose @ motion.transformation.numpy()
        # too little texture or depth in one of them: no pose of this frame
        except RuntimeError as error:
            print(stamp, error)
            last = image
            continue
        last = image
        stamps.append(float(stamp))
        poses.append(pose)
    write_tum(output, Trajectory(np.array(stamps), np.array(poses)))


main(*sys.argv[1:])
