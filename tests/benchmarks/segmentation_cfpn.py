"""FPN against CFPN: the small network trained twice from scratch, all else equal, on rendered sequences.

    python tests/benchmarks/segmentation_cfpn.py RUNS --iterations 300 --seeds 0 1

Both networks of a seed see the same images in the same order. They are compared on held-out instances at the frames'
own resolution. What comes out holds for rendered data only. Prints a Markdown table and writes ``RUNS/cfpn.json``.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # the checkout that this script lies in


def main() -> int:
    """Train, evaluate, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, help="folder of the training runs; interrupted runs go on")
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--data", default="synthetic:scenes=0-99,frames=1,options=0.3,seed=3")
    parser.add_argument("--validation", default="synthetic:scenes=90-94,frames=1,seed=2")
    parser.add_argument("--held-out", default="synthetic:scenes=100-119,frames=1,seed=5")
    parser.add_argument("--cache", type=Path, default=None, help="folder of prepared images")
    parser.add_argument("--precision", default="float32", choices=("float32", "bfloat16"))
    options = parser.parse_args()

    from dynslam_bench.segmentation.settings import SegmentationSettings
    from dynslam_bench.segmentation.training.evaluate_masks import evaluate_segmenter
    from dynslam_bench.segmentation.training.settings import TrainSettings
    from dynslam_bench.segmentation.training.train import train

    rows = []
    for seed in options.seeds:
        for cfpn in (False, True):
            name = f"{'cfpn' if cfpn else 'fpn'}-{seed}"
            settings = TrainSettings(
                cfpn=cfpn, seed=seed, data=(options.data,), validation=options.validation,
                iterations=options.iterations, evaluate_every=options.iterations, average=0.99, warmup=50,
                precision=options.precision,
            )  # fmt: skip
            trained = train(settings, options.runs / name, data_cache=options.cache or options.runs / "data")
            chosen = SegmentationSettings(source=f"weights:{trained.best}", network_side=0, confidence=0.5)
            score = evaluate_segmenter(chosen, options.held_out, min_area=200)
            rows.append({"network": name, **score.classes["person"]})
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    columns = ("ap", "ap50", "iou", "instance_iou", "recall")
    print("| network | " + " | ".join(columns) + " |\n|" + " --- |" * (len(columns) + 1))
    for row in rows:
        print(f"| {row['network']} | " + " | ".join(f"{row[column]:.4f}" for column in columns) + " |")
    (options.runs / "cfpn.json").write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
