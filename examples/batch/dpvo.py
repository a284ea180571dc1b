"""DPVO on a whole sequence, by the function of its demo.py.

CHECKOUT CAMERA SEQUENCE OUTPUT, then names of its configuration, each with its value: PATCHES_PER_FRAME 96.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
from demo import cfg, run  # of the checkout


def main(checkout: str, camera: str, sequence: str, output: str, *options: str) -> None:
    settings = cv2.FileStorage(camera, cv2.FILE_STORAGE_READ)
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    np.savetxt("calibration.txt", [[settings.getNode(f"Camera1.{name}").real() for name in names]])
    cfg.merge_from_file(f"{checkout}/config/default.yaml")
    cfg.merge_from_list(list(options))
    poses, indices = run(
        cfg, f"{checkout}/dpvo.pth", f"{sequence}/rgb", "calibration.txt", stride=1
    )[:2]
    np.savetxt(output, np.column_stack([indices, poses]))


if __name__ == "__main__":  # it starts a process that reads the images
    Path(sys.argv[4]).unlink(missing_ok=True)
    main(*sys.argv[1:])
