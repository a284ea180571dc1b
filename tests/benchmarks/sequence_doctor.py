"""False alarms of `sequences doctor` on healthy recordings.

    python tests/benchmarks/sequence_doctor.py [FOLDER_OR_ID...] [--cut 60] [--first-scene 93] [--frames 100]

One line a recording, or a part of `--cut` frames: findings and processor time. Without names: a scene of every
rendered sequence. That faults are found is held by tests/sequences/test_sequence_doctor.py.
"""

from __future__ import annotations

import argparse
import time

from dynslam_bench.sequences import SequenceView, open_sequence
from dynslam_bench.sequences.doctor import examine
from dynslam_bench.sequences.synthetic import SYNTHETIC_IDS

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--data-root")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--first-scene", type=int, default=0)
    parser.add_argument("--cut", type=int, default=0)
    given = parser.parse_args()
    scenes = [(7 * number + given.first_scene) % 200 for number in range(len(SYNTHETIC_IDS))]
    rendered = [f"{id}?scene={scene}&frames={given.frames}" for id, scene in zip(SYNTHETIC_IDS, scenes, strict=True)]
    alarms = parts = 0
    for name in given.names or rendered:
        sequence = open_sequence(name, data_root=given.data_root)
        step = given.cut or len(sequence)
        for start in range(0, max(1, len(sequence) - step // 2), step):
            began = time.process_time()
            diagnosis = examine(SequenceView(sequence, start, start + step))
            seconds = time.process_time() - began
            parts, alarms = parts + 1, alarms + (not diagnosis.ok)
            findings = "; ".join(f"{f.severity} {f.id}: {f.text}" for f in diagnosis.findings)
            verdict = "ok   " if diagnosis.ok else "ALARM"
            print(f"{verdict} {name}[{start}:{start + step}] {seconds:.1f} s  {findings}", flush=True)
    print(f"{alarms} alarms on {parts} healthy recordings", flush=True)
