"""What `sequences doctor` finds: faults put into healthy recordings, healthy recordings, and its time.

    python tests/benchmarks/sequence_doctor.py faults FOLDER_OR_ID... [--only NAME]
    python tests/benchmarks/sequence_doctor.py healthy FOLDER_OR_ID... [--cut 60] [--first-scene 93] [--frames 100]

Every fault is put into a copy of the recording in TUM layout; a row says which finding was expected and which came.
`healthy` without names runs every rendered family, a scene each. The thresholds were chosen on the scenes of
`--first-scene 0`; those of any other first scene are new to them.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.sequences import SequenceView, open_sequence
from dynslam_bench.sequences.doctor import diagnose, examine
from dynslam_bench.sequences.synthetic.ids import SYNTHETIC_IDS

Poses = np.ndarray
FAULTS: dict[str, tuple[str, Callable[[Copy], None]]] = {}


class Copy:
    """A recording in TUM layout that may be altered."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.rows = {name: self._read(name) for name in ("rgb", "depth", "groundtruth")}

    def _read(self, name: str) -> list[list[str]]:
        lines = (self.folder / f"{name}.txt").read_text().splitlines()
        return [line.split() for line in lines if line and not line.startswith("#")]

    def write(self, name: str, rows: list[list[str]]) -> None:
        """Write a list again."""
        (self.folder / f"{name}.txt").write_text("\n".join(" ".join(row) for row in rows) + "\n")

    def images(self, kind: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
        """Change every image of a kind."""
        for path in sorted((self.folder / kind).iterdir()):
            image = change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
            path.unlink()
            cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])

    def drop(self, kind: str) -> None:
        """Remove the images of a kind and their list."""
        shutil.rmtree(self.folder / kind)
        (self.folder / f"{kind}.txt").unlink()

    def camera(self, **factors: float) -> None:
        """Multiply entries of the camera's file, or add to those of the principal point."""
        path = self.folder / "camera.toml"
        values = dict(line.split(" = ") for line in path.read_text().splitlines())
        for name, factor in factors.items():
            old = float(values[name])
            values[name] = repr(old + factor if name in ("cx", "cy") else old * factor)
        path.write_text("\n".join(f"{name} = {value}" for name, value in values.items()) + "\n")

    def truth(self, change: Callable[[np.ndarray], np.ndarray]) -> None:
        """Change the truth's numbers ``[N, 8]``."""
        table = change(np.array(self.rows["groundtruth"], dtype=float))
        self.write("groundtruth", [[f"{row[0]:.6f}", *(f"{value:.7f}" for value in row[1:])] for row in table])

    def poses(self, change: Callable[[Poses], Poses]) -> None:
        """Change the truth's poses."""

        def altered(table: np.ndarray) -> np.ndarray:
            poses = change(se3.from_quaternion(table[:, 1:4], table[:, 4:]))
            return np.column_stack([table[:, 0], *se3.to_quaternion(poses)])

        self.truth(altered)


def fault(name: str, finding: str) -> Callable[[Callable[[Copy], None]], Callable[[Copy], None]]:
    """Register a fault and the finding that names it."""

    def register(function: Callable[[Copy], None]) -> Callable[[Copy], None]:
        FAULTS[name] = finding, function
        return function

    return register


def moved(seconds: float) -> Callable[[Copy], None]:
    """The truth's stamps later by so much."""
    return lambda copy: copy.truth(lambda t: t + np.eye(1, 8)[0] * seconds)


def scaled(factor: float) -> Callable[[Copy], None]:
    """The truth's positions in another unit."""
    return lambda copy: copy.truth(lambda t: t * np.array([1, *[factor] * 3, 1, 1, 1, 1]))


def mounted(rotation: np.ndarray, lever: tuple[float, float, float]) -> Callable[[Copy], None]:
    """The truth of a body: its axes and position in the camera's frame."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, lever
    return lambda copy: copy.poses(lambda poses: poses @ pose)


def rolled(kind: str, *, right: int = 0, down: int = 0) -> Callable[[Copy], None]:
    """Images moved across."""

    def change(image: np.ndarray) -> np.ndarray:
        out = np.zeros_like(image)
        h, w = image.shape[:2]
        out[max(0, down) : h + min(0, down), max(0, right) : w + min(0, right)] = image[
            max(0, -down) : h - max(0, down), max(0, -right) : w - max(0, right)
        ]
        return out

    return lambda copy: copy.images(kind, change)


def delayed(kind: str, frames: int) -> Callable[[Copy], None]:
    """Each stamp of a list has the image of so many frames before."""

    def change(copy: Copy) -> None:
        rows = copy.rows[kind]
        stamps, files = [row[0] for row in rows], [row[1] for row in rows]
        pairs = (
            zip(stamps[max(0, frames) :], files[: len(files) - frames], strict=False)
            if frames > 0
            else zip(stamps[:frames], files[-frames:], strict=False)
        )
        copy.write(kind, [list(pair) for pair in pairs])

    return change


def repeated(kind: str, first: float, last: float) -> Callable[[Copy], None]:
    """One image from a share of the recording to another."""

    def change(copy: Copy) -> None:
        rows = copy.rows[kind]
        a, b = int(first * len(rows)), int(last * len(rows))
        copy.write(kind, [[row[0], rows[a][1] if a <= i < b else row[1]] for i, row in enumerate(rows)])

    return change


def metres_as_millimetres(copy: Copy) -> None:
    """Depth as arrays of floating-point millimetres."""
    factor = float(
        dict(line.split(" = ") for line in (copy.folder / "camera.toml").read_text().splitlines())["depth_factor"]
    )
    for row in copy.rows["depth"]:
        raw = cv2.imread(str(copy.folder / row[1]), cv2.IMREAD_UNCHANGED)
        row[1] = row[1].replace(".png", ".npy")
        np.save(copy.folder / row[1], raw.astype(np.float32) / factor * 1000)
    copy.write("depth", copy.rows["depth"])


def unrelated(copy: Copy) -> None:
    """The truth of a rendered sequence, at this one's stamps."""
    stamps = np.array([float(row[0]) for row in copy.rows["rgb"]])
    other = open_sequence("synthetic/fast_rpy@61?frames=600").ground_truth
    assert isinstance(other, Trajectory)
    poses = other.T_world_cam[100 : 100 + len(stamps)]
    table = np.column_stack([stamps, *se3.to_quaternion(poses)])
    copy.truth(lambda _: table)


W_FIRST = [0, 1, 2, 3, 7, 4, 5, 6]
AXES = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
"""Body axes, x forward and z up, in the optical frame of the camera (columns)."""
FAULTS |= {
    "truth 0.2 s late": ("truth-time-shift", moved(0.2)),
    "truth 0.1 s early": ("truth-time-shift", moved(-0.1)),
    "truth 0.7 s late": ("truth-time-shift", moved(0.7)),
    "truth in millimetres": ("truth-scale", scaled(1000)),
    "truth in centimetres": ("truth-scale", scaled(100)),
    "truth inverted": ("truth-inverted", lambda copy: copy.poses(se3.inverse)),
    "quaternions w first": ("truth-quaternion-order", lambda copy: copy.truth(lambda t: t[:, W_FIRST])),
    "lever arm 0.25 m": ("truth-lever-arm", mounted(np.eye(3), (0.15, -0.2, 0.0))),
    "lever arm 0.12 m": ("truth-lever-arm", mounted(np.eye(3), (0.0, -0.1, 0.07))),
    "body axes": ("truth-axes", mounted(AXES, (0, 0, 0))),
    "axes flipped": ("truth-axes", mounted(np.diag([1.0, -1, -1]), (0, 0, 0))),
    "axes turned by 20 degrees": ("truth-axes", mounted(se3.exp(np.array([0, 0, 0, 0, 0.35, 0]))[:3, :3], (0, 0, 0))),
    "positions mirrored": ("truth-axes", lambda copy: copy.truth(lambda t: t * np.array([1, 1, -1, 1, 1, 1, 1, 1]))),
    "depth factor x 5": ("depth-factor", lambda copy: copy.camera(depth_factor=5)),
    "depth factor x 0.2": ("depth-factor", lambda copy: copy.camera(depth_factor=0.2)),
    "depth factor x 1.2": ("depth-factor", lambda copy: copy.camera(depth_factor=1.2)),
    "depth bytes swapped": ("depth-byte-order", lambda copy: copy.images("depth", lambda image: image.byteswap())),
    "depth arrays in millimetres": ("depth-units", metres_as_millimetres),
    "depth of 8 bits": ("depth-format", lambda copy: copy.images("depth", lambda image: (image >> 8).astype(np.uint8))),
    "depth of half the size": ("depth-size", lambda copy: copy.images("depth", lambda image: image[::2, ::2].copy())),
    "depth 30 px right": ("depth-not-registered", rolled("depth", right=30)),
    "depth 20 px left, 12 up": ("depth-not-registered", rolled("depth", right=-20, down=-12)),
    "focal length x 2": ("camera-focal-length", lambda copy: copy.camera(fx=2, fy=2)),
    "focal length x 0.5": ("camera-focal-length", lambda copy: copy.camera(fx=0.5, fy=0.5)),
    "focal length x 1.2": ("camera-focal-length", lambda copy: copy.camera(fx=1.2, fy=1.2)),
    "principal point 80 px off": ("camera-principal-point", lambda copy: copy.camera(cx=-80.0, cy=30.0)),
    "colour upside down": ("colour-flipped", lambda copy: copy.images("rgb", lambda image: image[::-1].copy())),
    "colour turned by 180": ("colour-flipped", lambda copy: copy.images("rgb", lambda image: image[::-1, ::-1].copy())),
    "one colour image": ("colour-frozen", repeated("rgb", 0.0, 1.0)),
    "colour stops after 60 %": ("colour-frozen", repeated("rgb", 0.6, 1.0)),
    "depth stops": ("depth-frozen", repeated("depth", 0.5, 0.8)),
    "depth 5 frames late": ("depth-delay", delayed("depth", 5)),
    "depth 3 frames early": ("depth-delay", delayed("depth", -3)),
    "colour 4 frames late": ("depth-delay", delayed("rgb", 4)),
    "truth of another sequence": ("truth-other-sequence", unrelated),
    "truth of another day": ("truth-other-sequence", moved(86400)),
    "truth of 5 poses": ("truth-sparse", lambda copy: copy.truth(lambda t: t[:: max(1, len(t) // 5)][:5])),
    "colour black": ("colour-blank", lambda copy: copy.images("rgb", np.zeros_like)),
    "depth empty": ("depth-empty", lambda copy: copy.images("depth", np.zeros_like)),
    "no truth": ("no-truth", lambda copy: (copy.folder / "groundtruth.txt").unlink()),
    "no depth": ("no-depth", lambda copy: copy.drop("depth")),
    "one frame": ("too-short", lambda copy: (copy.write("rgb", copy.rows["rgb"][:1]),
                                             copy.write("depth", copy.rows["depth"][:1]))),
    "a third cut off": ("unreadable", lambda copy: [path.write_bytes(path.read_bytes()[:500])
                                                    for path in sorted((copy.folder / "rgb").iterdir())[1::3]]),
}  # fmt: skip


def write_folder(name: str, data_root: str | None, folder: Path, most: int) -> None:
    """The first frames of a recording, in TUM layout with its camera."""
    sequence = open_sequence(name, data_root=data_root)
    camera, truth = sequence.camera, sequence.ground_truth
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    lists: dict[str, list[str]] = {"rgb": [], "depth": []}
    for index in range(min(len(sequence), most)):
        frame = sequence[index]
        raw = np.round(frame.depth * camera.depth_factor).astype(np.uint16)
        for kind, image in (("rgb", frame.rgb[..., ::-1]), ("depth", raw)):
            file = f"{kind}/{frame.timestamp:.6f}.png"
            cv2.imwrite(str(folder / file), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            lists[kind].append(f"{frame.timestamp:.6f} {file}")
    for kind, lines in lists.items():
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    assert truth is not None
    position, quaternion = se3.to_quaternion(truth.T_world_cam)
    rows = np.column_stack([truth.timestamps, position, quaternion])
    (folder / "groundtruth.txt").write_text(
        "\n".join(f"{row[0]:.6f} " + " ".join(f"{value:.7f}" for value in row[1:]) for row in rows) + "\n"
    )
    values = {
        key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy", "depth_factor", "readout_s")
    }
    values["distortion"] = list(camera.distortion)
    (folder / "camera.toml").write_text("\n".join(f"{key} = {value}" for key, value in values.items()) + "\n")


def run_faults(names: list[str], data_root: str | None, only: str, most: int) -> None:
    """A row for each fault in each recording."""
    with tempfile.TemporaryDirectory() as scratch:
        for number, name in enumerate(names):
            base = Path(scratch) / f"base{number}"
            write_folder(name, data_root, base, most)
            right = tried = 0
            for title, (expected, put) in FAULTS.items():
                if only and title not in only.split(","):
                    continue
                folder = Path(scratch) / "altered"
                shutil.copytree(base, folder)
                put(Copy(folder))
                start = time.process_time()
                diagnosis = diagnose(folder)
                seconds = time.process_time() - start
                ids = [finding.id for finding in diagnosis.findings]
                ok = expected in ids and all(f.id == expected for f in diagnosis.findings if f.severity == "fault")
                right, tried = right + ok, tried + 1
                text = diagnosis.findings[0].text[:230] if diagnosis.findings else "-"
                names = ",".join(ids) or "-"
                print(
                    f"{'ok ' if ok else 'NOT'} {title:28} {expected:22} {names:30} {seconds:5.1f} s  {text}",
                    flush=True,
                )
                shutil.rmtree(folder)
            print(f"{name}: {right} of {tried} named rightly", flush=True)


def run_healthy(names: list[str], data_root: str | None, cut: int) -> None:
    """A row for each healthy recording, or part of one."""
    alarms = parts = 0
    for name in names:
        sequence = open_sequence(name, data_root=data_root)
        step = cut or len(sequence)
        for start in range(0, max(1, len(sequence) - step // 2), step):
            part = SequenceView(sequence, start, start + step)
            began = time.process_time()
            diagnosis = examine(part)
            seconds = time.process_time() - began
            parts, alarms = parts + 1, alarms + (not diagnosis.ok)
            said = "; ".join(f"{f.severity} {f.id}: {f.text}" for f in diagnosis.findings)
            print(
                f"{'ALARM' if not diagnosis.ok else 'ok   '} {name}[{start}:{start + step}] {seconds:.1f} s  {said}",
                flush=True,
            )
    print(f"{alarms} alarms on {parts} healthy recordings", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("faults", "healthy"))
    parser.add_argument("names", nargs="*")
    parser.add_argument("--data-root")
    parser.add_argument("--only", default="")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--first-scene", type=int, default=0)
    parser.add_argument("--cut", type=int, default=0)
    given = parser.parse_args()
    if given.what == "faults":
        run_faults(given.names, given.data_root, given.only, given.frames)
    else:
        rendered = [
            f"{family}?scene={(7 * number + given.first_scene) % 200}&frames={given.frames}"
            for number, family in enumerate(SYNTHETIC_IDS)
        ]
        run_healthy(given.names or rendered, given.data_root, given.cut)
