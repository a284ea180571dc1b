"""What `run --rrd` costs: processor time of whole runs without and with it, in turn, and of the frames alone.

    python tests/benchmarks/recording_cost.py [--tracker orb-slam2] [--frames 200] [--rounds 3]

Needs rerun-sdk. Frames are rendered before the first round.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

RUN = """
import sys, time
from pathlib import Path
from dynslam_bench.runs.loop import run_loop
from dynslam_bench.runs.spec import RunSpec
from dynslam_bench.evaluation.protocol import get_protocol
tracker, sequence, rrd, folder = sys.argv[1:]
spec = RunSpec(tracker=tracker, sequence=sequence, rrd=rrd == "yes", device="cpu").model_dump(mode="json")
marks = []
def send(message):
    if message["type"] == "frame":
        marks.append(time.process_time())
job = {"spec": spec, "folder": folder, "protocol": get_protocol("tum-rgbd/v1").model_dump(mode="json"),
       "progress_every": 10**6}
run_loop(job, send, lambda: False)
print(marks[-1] - marks[len(marks) // 4], len(marks) - 1 - len(marks) // 4)
"""


def measure(tracker: str, sequence: str, rrd: bool) -> tuple[float, float]:
    """Processor seconds of a whole run, and milliseconds a frame over its last three quarters."""
    with tempfile.TemporaryDirectory() as folder:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [sys.executable, "-c", RUN, tracker, sequence, "yes" if rrd else "no", folder]
        out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert (Path(folder) / "recording.rrd").is_file() == rrd
    spent, frames = out.split()[-2:]
    whole = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return whole, 1000 * float(spent) / int(frames)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--tracker", default="orb-slam2")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args()
    sequence = f"synthetic/walking_xyz@100?frames={asked.frames}"
    measure(asked.tracker, sequence, False)
    pairs = [[measure(asked.tracker, sequence, rrd) for rrd in (False, True)] for _ in range(asked.rounds)]
    for plain, recorded in pairs:
        print(
            f"{asked.tracker}, {asked.frames} frames: {plain[0]:.2f} and {recorded[0]:.2f} CPU s a run, "
            f"{plain[1]:.1f} and {recorded[1]:.1f} CPU ms a frame"
        )
    whole, frame = (median(b[at] / a[at] - 1 for a, b in pairs) for at in (0, 1))
    print(f"median: a run {100 * whole:+.1f} %, a frame {100 * frame:+.1f} %")


if __name__ == "__main__":
    main()
