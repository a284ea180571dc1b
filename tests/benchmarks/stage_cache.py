"""The stage cache in one paired run: the same study of epipolar thresholds without it, then with it.

    python tests/benchmarks/stage_cache.py [--segmenter embedded | onnx:FILE | resnet50 ...] [--sequence ID]
        [--frames 30] [--trials 10]

Both studies draw the same settings (random sampler, one seed) and run every trial whole. Printed: wall time of the
studies and of a trial (median over the trials after the first, which fills the cache), whether every trajectory has the
same bytes, and the stages' times as the runs report them. The default sequence is the Bonn excerpt beside the checkout
with its YOLO network where present, and a rendered one with the embedded network. `resnet50` is the full-size Mask
R-CNN with random weights: its time does not depend on them. The cache starts empty.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

import numpy as np

SHARED = Path(__file__).resolve().parents[3] / "shared"
BONN = SHARED / "data" / "bonn" / "rgbd_bonn_crowd"
YOLO = SHARED / "weights" / "yolov8n-seg_480x640_fp32.onnx"


def study(sequence: str, segmenter: str, trials: int, cache: bool, results: Path) -> tuple[float, list[float], dict]:
    """Seconds of the study and of its trials, and the trials' runs by settings and seed."""
    from dynslam_bench.runs import RunStore
    from dynslam_bench.tuning import SpaceSpec, StudySpec, run_study

    spec = StudySpec(
        name="epipolar", tune=(sequence,), seeds=(0,), trials=trials, sampler="random", pruner="none",
        min_coverage=None, cache=cache,
        space=SpaceSpec(include=("epipolar.threshold_px",), fixed={"segmentation.source": segmenter}),
    )  # fmt: skip
    begin = time.perf_counter()
    tuner = run_study(spec, results=results)
    total = time.perf_counter() - begin
    store = RunStore(results)
    found, seconds = {}, []
    for trial in tuner.study.get_trials():
        run_id = trial.user_attrs["instances"][0][1]
        run = store.get(run_id), store.trajectory(run_id, "online"), trial.value
        found[trial.params["epipolar.threshold_px"]] = run
        seconds.append(trial.duration.total_seconds())
    return total, seconds, found


def beginning(source: Path, frames: int, folder: Path) -> str:
    """A sequence folder of the same name with the first colour images only; everything else is linked."""
    target = folder / source.name
    target.mkdir(parents=True)
    for part in source.iterdir():
        if part.name != "rgb.txt":
            (target / part.name).symlink_to(part)
    lines = (source / "rgb.txt").read_text().splitlines()
    images = [line for line in lines if not line.startswith("#")][:frames]
    (target / "rgb.txt").write_text("\n".join(images) + "\n")
    return str(target)


def full_size(folder: Path) -> str:
    """Source of a Mask R-CNN of the published size with random weights."""
    import torch

    from dynslam_bench.segmentation.networks.backbone import NetworkConfig
    from dynslam_bench.segmentation.networks.loading import save_network
    from dynslam_bench.segmentation.networks.network import MaskRCNN

    torch.manual_seed(0)
    save_network(MaskRCNN(NetworkConfig()), folder / "resnet50.pt")
    return f"weights:{folder / 'resnet50.pt'}"


def paired(sequence: str, segmenter: str, trials: int, frames: int) -> None:
    """Print the comparison for one sequence and network."""
    from dynslam_bench.sequences.catalogue import open_sequence

    with tempfile.TemporaryDirectory() as folder:
        os.environ["DYNSLAM_BENCH_CACHE"] = str(Path(folder) / "cache")
        if Path(sequence).is_dir():
            sequence = beginning(Path(sequence), frames, Path(folder) / "data")
        if segmenter == "resnet50":
            segmenter = full_size(Path(folder))
        opened = open_sequence(sequence)
        for index in range(len(opened)):  # rendered sequences are rendered now
            opened[index]
        cold_s, cold_trials, cold = study(sequence, segmenter, trials, False, Path(folder) / "uncached")
        warm_s, warm_trials, warm = study(sequence, segmenter, trials, True, Path(folder) / "cached")
    assert cold.keys() == warm.keys(), "both studies draw the same settings"
    pairs = [(cold[threshold], warm[threshold]) for threshold in cold]
    same = all(np.array_equal(a[1].T_world_cam, b[1].T_world_cam) and a[2] == b[2] for a, b in pairs)
    print(f"\n{Path(sequence).name}, {Path(segmenter).name}: {trials} trials of {len(opened)} frames")
    print(f"  study   {cold_s:7.1f} s uncached, {warm_s:7.1f} s cached: {cold_s / warm_s:.1f} x")
    one, other = float(np.median(cold_trials[1:])), float(np.median(warm_trials[1:]))
    print(f"  a trial {one:7.2f} s uncached, {other:7.2f} s cached: {one / other:.1f} x")
    print(f"  trajectories and objective values identical bit for bit: {'yes' if same else 'NO'}")
    print("  stage ms a frame, mean over trials: uncached / as reported by the cached runs")
    stages = next(iter(cold.values()))[0].timings
    for stage in stages:
        a = 1e3 * float(np.mean([record.timings[stage].mean_s for record, _, _ in cold.values()]))
        b = 1e3 * float(np.mean([record.timings[stage].mean_s for record, _, _ in warm.values()]))
        print(f"    {stage:20s} {a:8.2f} {b:8.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--segmenter", default=None)
    parser.add_argument("--sequence", default=None)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--trials", type=int, default=10)
    options = parser.parse_args()
    cases = [(f"synthetic/walking_xyz?frames={options.frames}", "embedded")]
    if BONN.is_dir() and YOLO.is_file():
        cases.append((str(BONN), f"onnx:{YOLO}"))
    if options.sequence or options.segmenter:
        cases = [(options.sequence or cases[0][0], options.segmenter or "embedded")]
    for sequence, segmenter in cases:
        paired(sequence, segmenter, options.trials, options.frames)


if __name__ == "__main__":
    main()
