"""A system of VSLAM-LAB on a whole sequence: CHECKOUT SYSTEM MODE CAMERA SEQUENCE OUTPUT.

Writes the sequence's tables as VSLAM-LAB does, runs `pixi run -e SYSTEM execute-MODE`, and reads
its table of poses. Systems whose task takes `key:value` in place of `--key value`, such as
orbslam2, need that change below.
"""

import subprocess
import sys
from pathlib import Path

import cv2

from dynslam_bench.geometry import write_tum
from dynslam_bench.runs import read_trajectory


def main(checkout: str, system: str, mode: str, camera: str, sequence: str, output: str) -> None:
    settings = cv2.FileStorage(camera, cv2.FILE_STORAGE_READ)
    work = Path(output).parent
    number = {
        name: settings.getNode(f"Camera1.{name}").real()
        for name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    }
    fx, fy, cx, cy, *distortion = number.values()
    width, height, fps = (
        int(settings.getNode(f"Camera.{name}").real()) for name in ("width", "height", "fps")
    )
    factor = settings.getNode("DepthMapFactor").real()
    (work / "calibration.yaml").write_text(
        "%YAML:1.2\n---\ncameras:\n"
        f"  - {{cam_name: rgb_0, cam_type: rgb+depth, depth_name: depth_0, cam_model: radtan5,"
        f" distortion_type: radtan5, focal_length: [{fx}, {fy}], principal_point: [{cx}, {cy}],"
        f" distortion_coefficients: {distortion},"
        f" image_dimension: [{width}, {height}], fps: {fps}, depth_factor: {factor},"
        " T_BS: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}\n"
    )

    # the table of images: stamps in nanoseconds
    rows = ["ts_rgb_0 (ns),path_rgb_0,ts_depth_0 (ns),path_depth_0"]
    for line in Path(sequence, "associations.txt").read_text().splitlines():
        stamp, rgb, *rest = line.split()
        ns = round(float(stamp) * 1e6) * 1000
        rows.append(f"{ns},{rgb},{ns},{rest[1] if rest else ''}")
    (work / "rgb.csv").write_text("\n".join(rows) + "\n")

    arguments = {
        "sequence_path": sequence, "calibration_yaml": work / "calibration.yaml", "rgb_csv": work / "rgb.csv",
        "exp_folder": work, "exp_it": 0, "verbose": 0, "mode": mode,
    }  # fmt: skip
    words = [str(word) for key, value in arguments.items() for word in (f"--{key}", value)]
    subprocess.run(
        ["pixi", "run", "--frozen", "-e", system, f"execute-{mode}", *words],
        cwd=checkout,
        check=True,
    )
    poses = next(work.glob("*_KeyFrameTrajectory.csv"))
    write_tum(output, read_trajectory(poses).trajectory)


main(*sys.argv[1:])
