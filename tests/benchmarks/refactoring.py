"""Does a change of the code's shape leave every result as it was, to the last bit?

    python tests/benchmarks/refactoring.py --record          # before: write refactoring.json
    python tests/benchmarks/refactoring.py                   # after: exit code 1 where anything differs
    python tests/benchmarks/refactoring.py --only orb-slam2  # after, of some trackers

Whether it made them slower: ``dynslam-bench gate compare REVISION --gate tests/benchmarks/speed.gate.toml``.

Twelve trackers on three sequences (two rendered instances that nobody tunes on, and the Bonn
excerpt where it is present), one thread, seed 0. A digest covers the state and the 16 numbers of
every online pose, the final trajectory, the culled features of every frame, and the names of the
stats. Bits depend on processor and versions, which are recorded too: on another machine, record at
the revision to compare with first.
"""

from one_thread import ROOT  # before all others

# isort: split
import hashlib
import json
import platform
from pathlib import Path

import cv2
import numpy as np
import torch
from command_line import parser_of

from dynslam_bench.sequences import open_sequence
from dynslam_bench.trackers import TrackerContext, build_tracker

RECORDED = Path(__file__).with_suffix(".json")
TRACKERS = (
    "orb-slam2", "mask-rcnn", "emfoa-oft", "emfoa-oft?masks=none", "emfoa-oft-paper", "dynaslam", "dynaslam-g",
    "ds-slam", "dai-slam", "di-slam", "huai-slam", "ngd-slam",
)  # fmt: skip
EXCERPT = ROOT.parent / "shared/data/bonn/rgbd_bonn_crowd"
SEQUENCES = ("synthetic/walking_xyz?scene=100", "synthetic/sitting_rpy?scene=101", str(EXCERPT))
MASKS = f"onnx:{ROOT.parent / 'shared/weights/yolov8n-seg_480x640_fp32.onnx'}"


def machine() -> dict[str, str]:
    """What the bits depend on besides the code."""
    model = next(
        (line for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line),
        "",
    )
    return {
        "processor": model.partition(":")[2].strip() or platform.processor(),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "torch": torch.__version__,
    }


def run(tracker_id: str, name: str, frames: int) -> str:
    """Digest of everything a tracker says about a sequence's first frames."""
    sequence = open_sequence(name, frames=(0, frames))
    rendered = name.startswith("synthetic/")
    masked = tracker_id not in ("orb-slam2", "emfoa-oft?masks=none", "dynaslam-g", "dai-slam")
    overrides = {"segmentation.source": "embedded" if rendered else MASKS} if masked else {}
    tracker = build_tracker(
        tracker_id, overrides, TrackerContext(sequence_id=sequence.id, masks=sequence.masks)
    )
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    whole = hashlib.sha256()
    for frame in (sequence[i] for i in range(len(sequence))):
        result = tracker.track(frame)
        whole.update(result.state.encode())
        whole.update(" ".join(sorted(result.stats)).encode())
        for array in (result.T_world_cam, result.keypoints_keep):
            whole.update(b"none" if array is None else np.ascontiguousarray(array).tobytes())
    if hasattr(tracker, "finalize"):
        whole.update(np.ascontiguousarray(tracker.finalize().T_world_cam).tobytes())
    return whole.hexdigest()[:16]


def main() -> int:
    """Record, compare, or time."""
    parser = parser_of(__doc__, record=False, frames=16)
    parser.add_argument(
        "--only", nargs="+", choices=TRACKERS, default=TRACKERS, help="compare these trackers alone"
    )
    arguments = parser.parse_args()
    if arguments.record and arguments.only != TRACKERS:
        parser.error("--record takes all trackers")
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    sequences = [name for name in SEQUENCES if name.startswith("synthetic/") or Path(name).is_dir()]
    before = {} if arguments.record else json.loads(RECORDED.read_text())
    if before and (before["machine"] != machine() or before["frames"] != arguments.frames):
        print(
            f"recorded on {before['machine']}, {before['frames']} frames; here {machine()}: record here first"
        )
        return 2
    digests = {}
    differing = []
    for name in sequences:
        for tracker in arguments.only:
            key = f"{tracker} | {'bonn/crowd' if name == str(EXCERPT) else name}"
            digests[key] = run(tracker, name, arguments.frames)
            verdict = (
                ""
                if arguments.record
                else ("same" if before["digests"].get(key) == digests[key] else "DIFFERS")
            )
            differing += [key] if verdict == "DIFFERS" else []
            print(f"{key:48s} {digests[key]} {verdict}", flush=True)
    if arguments.record:
        document = {"machine": machine(), "frames": arguments.frames, "digests": digests}
        RECORDED.write_text(json.dumps(document, indent=1) + "\n")
    print(
        f"{len(digests)} runs, {len(differing)} differ"
        if not arguments.record
        else f"wrote {RECORDED.name}"
    )
    return 1 if differing else 0


if __name__ == "__main__":
    raise SystemExit(main())
