"""Helpers of the tests of the command line: errors of one line, and sequences as folders."""

import cv2
import numpy as np

from dynslam_bench.geometry.trajectory_files import write_tum
from dynslam_bench.sequences.cameras import write_camera


def one_line(err):
    assert err.startswith("error: ") and err.count("\n") == 1 and "Traceback" not in err
    return err


def write_folder(folder, scene, truth=None):
    """A sequence as a folder in TUM layout, with its own ground truth or another one."""
    lists = {"rgb": [], "depth": []}
    for kind in lists:
        (folder / kind).mkdir(parents=True)
    for frame in (scene[i] for i in range(len(scene))):
        images = {"rgb": frame.rgb[..., ::-1], "depth": np.round(frame.depth * 5000).astype(np.uint16)}
        for kind, image in images.items():
            cv2.imwrite(str(folder / kind / f"{frame.index}.png"), image)
            lists[kind].append(f"{frame.timestamp:.6f} {kind}/{frame.index}.png")
    for kind, lines in lists.items():
        (folder / f"{kind}.txt").write_text("\n".join(lines))
    write_tum(folder / "groundtruth.txt", truth or scene.ground_truth)
    write_camera(folder / "camera.toml", scene.camera, fps=30)
    return folder
