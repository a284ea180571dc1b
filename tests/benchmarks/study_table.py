"""Print what studies found as a Markdown table: the best trial, and default settings that are not the baseline.

python tests/benchmarks/study_table.py RESULTS STUDY ...
"""

import sys
from pathlib import Path

from dynslam_bench.tuning import StudySummary

SPLITS = {"confirm": "choice", "held_out": "held out"}

print("| study | settings, split | scenes | ATE over the baseline's | 95 % interval |")
print("| --- | --- | --- | --- | --- |")
for name in sys.argv[2:]:
    summary = StudySummary.read(Path(sys.argv[1]) / "studies" / name / "summary.json")
    rows = {
        f"trial {summary.candidates[0].trial}": {
            split: getattr(summary.candidates[0], split) for split in SPLITS
        }
    }
    for settings, ratios in (rows | {"shipped default": summary.shipped}).items():
        for split, ratio in ratios.items():
            interval = f"{ratio.low:.3f} to {ratio.high:.3f}"
            print(
                f"| {name} | {settings}, {SPLITS[split]} | {ratio.sequences} | {ratio.ratio:.3f} | {interval} |"
            )
