"""On how many frames does the fundamental matrix judge? And what does the flow cost that leads to it?

    python tests/benchmarks/epipolar_share.py [--only emfoa-oft opf-slam] [--sequences SEQUENCE...] [--frames 0:60]
        [--offsets 0 1 2 3] [--masks SOURCE] [--cache DIR] [--write FILE]

A row each: share of the tracked frames on which no fundamental matrix judged (`RunRecord.epipolar_skipped`), online ATE
in mm, coverage, and the median times of the flow and of the whole frame in ms, means over the start offsets. A sequence
is an id or a folder; masks are those of `segmentation.source`. `--write` puts the shares into the package's own table,
which `dynslam-bench trackers info` shows.
"""

import one_thread  # noqa: F401  # before all others

# isort: split
import argparse
import json
from pathlib import Path

import numpy as np

from dynslam_bench.envs.slam_env import SlamEnv
from dynslam_bench.runs.frames import FrameLog, FrameRow
from dynslam_bench.trackers import TRACKERS

TRACKERS_WITH_F = (
    "emfoa-oft", "emfoa-oft?depth=none", "emfoa-oft?flow=lucas-kanade", "emfoa-oft?search=patchmatch",
    "emfoa-oft?search=emfoa-literal", "emfoa-oft?masks=vote&depth=none", "emfoa-oft?masks=vote",
    "emfoa-oft?masks=none", "emfoa-oft?masks=none&depth=none", "emfoa-oft-paper",
    "emfoa-oft-paper?flow=sparse", "emfoa-oft-paper?masks=none", "opf-slam", "chen-slam", "blitz-slam",
    "mor-slam", "sgc-slam", "di-slam", "ds-slam", "sof-slam", "seg-slam",
)  # fmt: skip
SEQUENCES = ("synthetic/walking_xyz?scene=100", "synthetic/walking_halfsphere?scene=100")


def measure(tracker: str, sequence: str, frames: tuple[int, int | None], masks: str, cache: str | None) -> np.ndarray:
    """Share of frames without F, ATE in m, coverage, flow and frame time in s."""
    semantic = masks and "segmentation" in TRACKERS.get(tracker).settings.model_fields
    settings = {"segmentation.source": masks} if semantic else {}
    env = SlamEnv(sequence, tracker, settings=settings, frames=frames, cache=cache)
    env.reset(seed=0)
    over = False
    while not over:
        *_, terminated, truncated, _ = env.step(0)
        over = terminated or truncated
    outcomes = env.episode.outcomes
    log = FrameLog([FrameRow.of(each) for each in outcomes])
    share = log.epipolar_skipped()
    times = [(each.timings.get("flow", 0.0), each.timings["total"]) for each in outcomes[1:] if each.timings]
    metrics = env.episode_metrics()
    env.close()
    return np.array(
        [np.nan if share is None else share, metrics.get("ate_rmse_m", np.nan), log.count("ok") / len(outcomes),
         *np.median(times, axis=0)]
    )  # fmt: skip


def write(path: Path, tracker: str, sequence: str, share: float) -> None:
    """Put one share into the table, in place of an older one."""
    table = json.loads(path.read_text()) if path.exists() else {}
    table.setdefault(tracker, {})[sequence] = round(share, 3)
    path.write_text(json.dumps(table, indent=1, sort_keys=True) + "\n")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", nargs="+", default=list(TRACKERS_WITH_F))
    parser.add_argument("--sequences", nargs="+", default=list(SEQUENCES))
    parser.add_argument("--frames", default="0:60")
    parser.add_argument("--offsets", type=int, nargs="+", default=[0])
    parser.add_argument("--masks", default="")
    parser.add_argument("--label", default="", help="name of the sequence in the table, where it is a folder")
    parser.add_argument("--cache")
    parser.add_argument("--write", type=Path, metavar="dynslam_bench/trackers/epipolar_skipped.json")
    options = parser.parse_args()
    first, last = (int(part) if part else None for part in options.frames.split(":"))
    print(
        "| tracker | sequence | F not used | ATE mm | by offset | coverage | flow ms | frame ms |\n"
        + "| --- " * 8
        + "|"
    )
    for sequence in options.sequences:
        for tracker in options.only:
            parts = [((first or 0) + offset, last) for offset in options.offsets]
            found = np.array([measure(tracker, sequence, part, options.masks, options.cache) for part in parts])
            share, ate, coverage, flow, total = found.mean(axis=0)
            each = ", ".join(f"{1000 * value:.1f}" for value in found[:, 1])
            print(
                f"| `{tracker}` | {options.label or sequence} | {100 * share:.0f} % | {1000 * ate:.1f} | {each} | "
                f"{100 * coverage:.0f} % | {1000 * flow:.1f} | {1000 * total:.0f} |",
                flush=True,
            )
            if options.write and np.isfinite(share):
                write(options.write, tracker, f"{options.label or sequence}, frames {options.frames}", share)


if __name__ == "__main__":
    main()
