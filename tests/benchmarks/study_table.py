"""Print what studies found as a Markdown table: the best trial, and default settings that are not the baseline.

python tests/benchmarks/study_table.py RESULTS STUDY ...
"""

import sys
from pathlib import Path

from dynslam_bench.tuning import StudySummary

SPLITS = {"confirm": "choice", "held_out": "held out"}

print("| study | settings, split | scenes | typical ratio to the baseline | interval | losses |")
print("| --- | --- | --- | --- | --- | --- |")
for name in sys.argv[2:]:
    summary = StudySummary.read(Path(sys.argv[1]) / "studies" / name / "summary.json")
    rows = {
        f"trial {summary.candidates[0].trial}": {
            split: getattr(summary.candidates[0], split) for split in SPLITS
        }
    }
    for settings, ratios in (rows | {"shipped default": summary.shipped}).items():
        for split, ratio in ratios.items():
            if ratio is None or ratio.ratio is None:
                continue
            losses = f"{len(ratio.losses)} : {len(ratio.losses_baseline)}"
            cells = [
                name,
                f"{settings}, {SPLITS[split]}",
                ratio.scenes,
                f"{ratio.ratio:.3f}",
                ratio.interval,
                losses,
            ]
            print(f"| {' | '.join(map(str, cells))} |")
    print(f"\n{name}: {summary.conclusion}\n", file=sys.stderr)
