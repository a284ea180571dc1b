"""Two trackers in turn (A B A B ...) on the same frames: pose error, coverage, frame time, and the ratios.

    python tests/benchmarks/compare_trackers.py --a orb-slam2 --b orbslam3 \\
        --sequences ../shared/data/bonn/rgbd_bonn_crowd --repeats 5 --offsets 0 5 10 --threads 2 --json out.json

ATE is the RMSE of the translation under --protocol (SE(3) alignment unless told otherwise), over the frames that both
trackers of a pair of runs have; "own" is over each one's own tracked frames. Online and final trajectory are scored
apart; a tracker without a final one shows a dash. A frame's time is that of `track()`, decoding excluded; medians and
95th percentiles are taken over the frames of a run, then the median over the runs. CPU times include the programs that
a tracker has started; that of the main threads is what a frame takes on a machine that does nothing else. --offsets
starts the sequence later, as other samples of the same scene; a last table then pools them. --threads sets the threads
of OpenCV, OpenMP, torch and the tracker's context; with --pin the process and its children are also held to that many
cores, which is the only limit that ORB-SLAM3's own threads know. Vary nothing but the trackers: the machine's other
load hits both alike because the runs alternate.
"""

import argparse
import gc
import json
import os
import sys
import time
from functools import reduce
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # the checkout that this script lies in
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--a", required=True, help="tracker id, id:value, module:Attr or file.py:Attr")
    parser.add_argument("--b", required=True)
    parser.add_argument("--sequences", nargs="+", required=True, help="ids or folders in TUM layout")
    parser.add_argument("--repeats", type=int, default=3, help="runs of each tracker, seeds 0, 1, ...")
    parser.add_argument("--offsets", type=int, nargs="+", default=[0], help="first frames")
    parser.add_argument("--frames", type=int, default=None, help="at most so many frames from the offset on")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--pin", action="store_true", help="hold the process and its children to --threads cores")
    parser.add_argument("--data-root", default=None)
    parser.add_argument("--set-a", nargs="*", default=[], metavar="NAME=VALUE")
    parser.add_argument("--set-b", nargs="*", default=[], metavar="NAME=VALUE")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--protocol", default="tum-rgbd/v1", help="monocular trackers need tum-rgbd/v1-sim3")
    parser.add_argument("--json", type=Path, default=None, help="write every run's numbers to this file")
    return parser.parse_args()


def main() -> int:
    options = arguments()
    for name in THREADS:
        os.environ[name] = str(options.threads)
    if options.pin and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: options.threads])

    import cv2
    import torch

    cv2.setNumThreads(options.threads)
    torch.set_num_threads(options.threads)

    from dynslam_bench.core.errors import DynslamError
    from dynslam_bench.sequences.catalogue import open_sequence

    try:
        results = []
        for name in options.sequences:
            parts = []
            for offset in options.offsets:
                stop = None if options.frames is None else offset + options.frames
                sequence = open_sequence(name, data_root=options.data_root, frames=(offset, stop))
                frames = [sequence[index] for index in range(len(sequence))]
                parts.append(compare(sequence, frames, offset, options))
            show(parts if len(parts) == 1 else [*parts, pooled(parts)], options)
            results += parts
    except DynslamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if options.json:
        options.json.write_text(json.dumps({"arguments": vars(options), "results": results}, indent=1, default=str))
    return 0


def compare(sequence, frames, offset: int, options: argparse.Namespace) -> dict:
    """All runs of both trackers on one part of a sequence."""
    runs: dict[str, list[dict]] = {"a": [], "b": []}
    for repeat in range(options.repeats):
        order = ("a", "b") if repeat % 2 == 0 else ("b", "a")
        outcome = {side: run(side, sequence, frames, repeat, options) for side in order}
        score_pair(outcome, sequence, options.protocol)
        for side in "ab":
            runs[side].append({key: value for key, value in outcome[side].items() if not key.startswith("_")})
            text = ", ".join(f"{key} {value:.4g}" for key, value in runs[side][-1].items() if value is not None)
            print(f"# {sequence.id} +{offset} run {repeat} {side}: {text}", file=sys.stderr, flush=True)
    return {"sequence": sequence.id, "offset": offset, "frames": len(frames), **runs}


def run(side: str, sequence, frames, seed: int, options: argparse.Namespace) -> dict:
    """One run; frames are decoded already."""
    import numpy as np

    from dynslam_bench.core.settings import parse_assignments
    from dynslam_bench.geometry.trajectory import Trajectory
    from dynslam_bench.trackers import TrackerContext, build_tracker

    context = TrackerContext(
        sequence_id=sequence.id, masks=sequence.masks, device=options.device, threads=options.threads, fps=sequence.fps
    )
    tracker = build_tracker(getattr(options, side), parse_assignments(getattr(options, f"set_{side}")), context)
    try:
        tracker.reset(sequence.camera, rng=np.random.default_rng(seed))
        gc.collect()
        seconds, stamps, poses = [], [], []
        before = processor_seconds()
        for frame in frames:
            start = time.perf_counter()
            result = tracker.track(frame)
            seconds.append(time.perf_counter() - start)
            if result.state == "ok":
                stamps.append(frame.timestamp)
                poses.append(result.T_world_cam)
        main_thread, all_threads = (after - first for after, first in zip(processor_seconds(), before, strict=True))
        final = tracker.finalize() if hasattr(tracker, "finalize") else None
    finally:
        if hasattr(tracker, "close"):
            tracker.close()
    return {
        "_online": Trajectory(np.array(stamps), np.array(poses)),
        "_final": final,
        "coverage": len(stamps) / len(frames),
        "median_ms": float(np.median(seconds)) * 1e3,
        "p95_ms": float(np.percentile(seconds, 95)) * 1e3,
        "main_cpu_ms": main_thread / len(frames) * 1e3,
        "all_cpu_ms": all_threads / len(frames) * 1e3,
    }


def processor_seconds() -> tuple[float, float]:
    """CPU time so far of the main threads, and of all threads, of this process and the programs it has started."""
    import psutil

    this = psutil.Process()
    main_thread = all_threads = 0.0
    for process in (this, *this.children(recursive=True)):
        times = {thread.id: thread.user_time + thread.system_time for thread in process.threads()}
        main_thread += times.get(process.pid, 0.0)
        all_threads += sum(times.values())
    return main_thread, all_threads


def score_pair(outcome: dict[str, dict], sequence, protocol: str) -> None:
    """Add the errors of one run of each, on common and on own frames."""
    import numpy as np

    for kind in ("online", "final"):
        both = {side: outcome[side][f"_{kind}"] for side in "ab"}
        present = {side: one for side, one in both.items() if one is not None and len(one)}
        stamps = [one.timestamps for one in present.values()]
        shared = {
            side: one.select(np.isin(one.timestamps, reduce(np.intersect1d, stamps))) for side, one in present.items()
        }
        for side in "ab":
            outcome[side][f"ate_{kind}_m"] = ate(shared.get(side), sequence, protocol)
            outcome[side][f"own_ate_{kind}_m"] = ate(both[side], sequence, protocol)


def ate(trajectory, sequence, protocol: str) -> float | None:
    from dynslam_bench.core.errors import EvaluationError
    from dynslam_bench.evaluation import evaluate

    if trajectory is None or sequence.ground_truth is None:
        return None
    try:
        return evaluate(trajectory, sequence.ground_truth, protocol).metrics["ate_rmse_m"]
    except EvaluationError:
        return None


def pooled(parts: list[dict]) -> dict:
    """All runs on all parts of a sequence as one."""
    runs = {side: [one for part in parts for one in part[side]] for side in "ab"}
    offsets = " and ".join(str(part["offset"]) for part in parts)
    return {
        "sequence": parts[0]["sequence"],
        "offset": offsets,
        "frames": sum(part["frames"] for part in parts),
        **runs,
    }


def show(results: list[dict], options: argparse.Namespace) -> None:
    """One table a part of a sequence: median and range over the runs, and the ratio of the medians B / A."""
    import numpy as np

    rows = (
        ("ATE online (m)", "ate_online_m"), ("ATE final (m)", "ate_final_m"),
        ("ATE online, own frames (m)", "own_ate_online_m"), ("ATE final, own frames (m)", "own_ate_final_m"),
        ("coverage", "coverage"), ("frame median (ms)", "median_ms"), ("frame p95 (ms)", "p95_ms"),
        ("CPU a frame, main threads (ms)", "main_cpu_ms"), ("CPU a frame, all threads (ms)", "all_cpu_ms"),
    )  # fmt: skip
    for result in results:
        part = f"{result['sequence']} from frame {result['offset']}, {result['frames']} frames"
        pinned = ", pinned" if options.pin else ""
        print(f"\n## {part}, {len(result['a'])} runs each, {options.threads} thread(s){pinned}\n")
        print(f"| median [min - max] | A = {options.a} | B = {options.b} | B / A |\n| --- | --- | --- | --- |")
        for title, key in rows:
            values = {side: [one[key] for one in result[side] if one[key] is not None] for side in "ab"}
            cells = [
                f"{np.median(seen):.4g} [{min(seen):.4g} - {max(seen):.4g}]" if seen else "-"
                for seen in values.values()
            ]
            both = values["a"] and values["b"] and np.median(values["a"]) > 0
            ratio = f"{np.median(values['b']) / np.median(values['a']):.3f}" if both else "-"
            print(f"| {title} | {cells[0]} | {cells[1]} | {ratio} |")


if __name__ == "__main__":
    sys.exit(main())
