"""Writers of the layouts in which data sets are published: small folders with known poses, images and traps."""

import cv2
import numpy as np

from dynslam_bench.geometry import se3

NED = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
BASE_CAM = se3.exp(np.array([0.2, -0.1, 0.9, 0.3, -1.1, 0.7]))
MATRIX = ", ".join(repr(value) for value in BASE_CAM.ravel().tolist())
"""`BASE_CAM` as files have it: sixteen numbers, row by row."""
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def random_poses(seed, n=3):
    """Camera-to-world poses ``[n, 4, 4]``, anywhere and turned anyhow."""
    rng = np.random.default_rng(seed)
    return se3.exp(np.concatenate([rng.normal(0, 3, (n, 3)), rng.normal(0, 1.2, (n, 3))], axis=1))


def tum_line(stamp, pose):
    """A pose as TUM's files have it, to the last digit."""
    position, quaternion = se3.to_quaternion(pose)
    return " ".join(repr(float(value)) for value in (stamp, *position, *quaternion))


def image(path, value, size, dtype=np.uint8):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(
        str(path), np.full((size[1], size[0], 3) if dtype is np.uint8 else size[::-1], value, dtype)
    )


def images(folder, names, size, raw):
    """Colour images of one grey and depth images of one raw value, each pair by a name."""
    for colour, depth in names:
        image(folder / colour, 90, size)
        image(folder / depth, raw, size, np.uint16)


def lines(path, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(rows) + "\n")


def write_tum(folder, poses, size=(640, 480), names=("rgb", "depth"), raw=10000):
    images(folder, [[f"{name}/{i}.png" for name in names] for i in range(len(poses))], size, raw)
    for name in names:
        listed = [f"{5 + i / 30:.6f} {name}/{i}.png" for i in range(len(poses))]
        lines(folder / f"{name}.txt", ["#Time Filename", *listed])
    lines(
        folder / "groundtruth.txt",
        [tum_line(round(5 + i / 30, 6), pose) for i, pose in enumerate(poses)],
    )


def write_eth3d(folder, poses, size=(739, 458)):
    """The mono archive's lists and calibration, and the rgbd archive's depth and pairs, in one folder."""
    write_tum(folder, poses, size)
    (folder / "depth.txt").unlink()
    stamps = [f"{5 + i / 30:.6f}" for i in range(len(poses))]
    lines(
        folder / "associated.txt",
        [f"{s} rgb/{i}.png {s} depth/{i}.png" for i, s in enumerate(stamps)],
    )
    lines(
        folder / "calibration.txt",
        ["726.28741455078 726.28741455078 354.6496887207 186.46566772461"],
    )


def write_icl(folder, poses, size=(640, 480)):
    """Frame 0 has no pose; poses are written with the y axis up, depth comes first in the associations."""
    images(folder, [(f"rgb/{i}.png", f"depth/{i}.png") for i in range(len(poses) + 1)], size, 10000)
    lines(
        folder / "associations.txt",
        [f"{i} depth/{i}.png {i} rgb/{i}.png" for i in range(len(poses) + 1)],
    )
    upward = MIRROR @ poses @ MIRROR
    lines(
        folder / "livingRoom0.gt.freiburg", [tum_line(i + 1, pose) for i, pose in enumerate(upward)]
    )


def write_seven_scenes(folder, poses, size=(640, 480)):
    for i, pose in enumerate(poses):
        image(folder / f"frame-{i:06d}.color.png", 90, size)
        image(folder / f"frame-{i:06d}.depth.png", 65535 if i == 1 else 2000, size, np.uint16)
        lines(
            folder / f"frame-{i:06d}.pose.txt",
            ["\t ".join(f"{value:.17e}" for value in row) for row in pose],
        )


def write_shibuya(folder, poses, size=(640, 360)):
    """Poses of a camera that looks along x; the first row of the depth is sky."""
    depth = np.full(size[::-1], 2.0, np.float32)
    depth[0] = 10000.0
    for i in range(len(poses)):
        image(folder / "image_0" / f"{i:06d}.png", 90, size)
        (folder / "depth_0").mkdir(exist_ok=True)
        np.save(folder / "depth_0" / f"{i:06d}.npy", depth)
    lines(folder / "times.txt", [f"{0.1 * i!r}" for i in range(len(poses))])
    lines(
        folder / "gt_pose.txt",
        [tum_line(0.1 * i, pose) for i, pose in enumerate(poses @ np.linalg.inv(NED))],
    )


def write_openloris(folder, poses, size=(848, 480)):
    write_tum(folder, poses @ np.linalg.inv(BASE_CAM), size, ("color", "aligned_depth"), 2000)
    (folder / "sensors.yaml").write_text(
        "%YAML:1.0\n---\nd400_color_optical_frame:\n   sensor_type: camera\n   fps: 30\n   width: 848\n   height: 480\n"
        "   intrinsics: !!opencv-matrix\n      rows: 1\n      cols: 4\n      dt: d\n"
        "      data: [ 6.11e+02, 4.33e+02,\n          6.12e+02, 2.49e+02 ]\n"
    )
    (folder / "trans_matrix.yaml").write_text(
        "%YAML:1.0\n---\ntrans_matrix:\n   - parent_frame: d400_color_optical_frame\n     child_frame: d400_gyroscope\n"
        "     matrix: !!opencv-matrix\n        rows: 4\n        cols: 4\n        dt: d\n        data: [ 1, 2, 3, 4 ]\n"
        "   - parent_frame: base_link\n     child_frame: d400_color_optical_frame\n     matrix: !!opencv-matrix\n"
        f"        rows: 4\n        cols: 4\n        dt: d\n        data: [ {MATRIX} ]\n"
    )


def write_vslam_lab(folder, poses, size=(64, 48)):
    stamps = [1403636579763555584 + i * 33_333_333 for i in range(len(poses))]
    images(folder, [(f"rgb_0/{i}.png", f"depth_0/{i}.png") for i in range(len(poses))], size, 2000)
    rows = [f"{stamp},rgb_0/{i}.png,{stamp}.0,depth_0/{i}.png" for i, stamp in enumerate(stamps)]
    lines(folder / "rgb.csv", ["ts_rgb_0 (ns),path_rgb_0,ts_depth_0 (ns),path_depth_0", *rows])
    body = poses @ np.linalg.inv(BASE_CAM)
    truth = [
        f"{stamp}," + ",".join(tum_line(0, pose).split()[1:])
        for stamp, pose in zip(stamps, body, strict=True)
    ]
    lines(folder / "groundtruth.csv", ["ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw", *truth])
    (folder / "calibration.yaml").write_text(
        "%YAML:1.0\n\ncameras:\n  - {cam_name: rgb_0,\n     cam_type: rgb+depth,\n     depth_name: depth_0,\n"
        "     cam_model: pinhole,\n     distortion_type: radtan5,\n     focal_length: [60.5, 61.5],\n"
        "     principal_point: [31.5, 23.5],\n     distortion_coefficients: [0.1, -0.2, 0.001, 0.002, 0.05], \n"
        f"     image_dimension: [{size[0]}, {size[1]}],\n     depth_factor: 1000.0,\n     fps: 30.0,\n"
        f"     T_BS: [{MATRIX}] # Sensor extrinsics wrt. the body-frame.\n    }}\n"
    )


def write_euroc(folder, poses, size=(64, 48)):
    """Nanoseconds, and a ground truth of the body with the quaternion's w first."""
    base = folder / "mav0"
    stamps = [1403636579763555584 + i * 50_000_000 for i in range(len(poses))]
    images(
        base,
        [(f"cam0/data/{stamp}.png", f"depth0/data/{stamp}.png") for stamp in stamps],
        size,
        2000,
    )
    for name in ("cam0", "depth0"):
        lines(
            base / name / "data.csv",
            ["#timestamp [ns],filename", *[f"{s},{s}.png" for s in stamps]],
        )
    position, q = se3.to_quaternion(poses @ np.linalg.inv(BASE_CAM))
    body = np.column_stack([position, q[:, [3, 0, 1, 2]], np.zeros((len(poses), 3))]).tolist()
    rows = [
        ",".join([str(stamp), *map(repr, row)]) for stamp, row in zip(stamps, body, strict=True)
    ]
    position = "p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m]"
    heading = f"#timestamp, {position}, q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v, v, v"
    lines(base / "state_groundtruth_estimate0" / "data.csv", [heading, *rows])
    (base / "depth0" / "sensor.yaml").write_text(
        "sensor_type: depth-camera\ndepth_factor: 1000.0\n"
    )
    (base / "cam0" / "sensor.yaml").write_text(
        "# General sensor definitions.\nsensor_type: camera\ncomment: VI-Sensor cam0 (MT9M034)\n\n# Extrinsics.\n"
        f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{MATRIX}]\n\nrate_hz: 20\nresolution: [{size[0]}, {size[1]}]\n"
        "camera_model: pinhole\nintrinsics: [58.6, 57.2, 31.2, 24.3] #fu, fv, cu, cv\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [-0.28, 0.07, 0.0001, 1.7e-05]\n"
    )


WRITERS = {
    "tum": write_tum,
    "eth3d": write_eth3d,
    "icl-nuim": write_icl,
    "7-scenes": write_seven_scenes,
    "tartanair-shibuya": write_shibuya,
    "openloris": write_openloris,
    "vslam-lab": write_vslam_lab,
    "euroc": write_euroc,
}
"""A writer for every layout that is read."""
