"""What `run --rrd` costs: wall and processor time of whole runs without and with it, in turn, and of the frames alone.

    python tests/benchmarks/recording_cost.py [--tracker orb-slam2] [--frames 200] [--rounds 3]

Needs rerun-sdk. Frames are rendered before the first round. A process beside the run loads rerun and writes the file:
on a free core that costs no wall time, its processor time counts all the same.

Bar: a whole run takes less than 5 % longer (wall time, on a machine with a free core).
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
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


def measure(tracker: str, sequence: str, rrd: bool) -> tuple[float, float, float]:
    """Wall and processor seconds of a whole run, and processor milliseconds a frame over its last three quarters."""
    with tempfile.TemporaryDirectory() as folder:
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        command = [sys.executable, "-c", RUN, tracker, sequence, "yes" if rrd else "no", folder]
        out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic() - began
        assert (Path(folder) / "recording.rrd").is_file() == rrd
    spent, frames = out.split()[-2:]
    whole = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return wall, whole, 1000 * float(spent) / int(frames)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--tracker", default="orb-slam2")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args()
    sequence = f"synthetic/walking_xyz?scene=100&frames={asked.frames}"
    measure(asked.tracker, sequence, False)
    pairs = [[measure(asked.tracker, sequence, rrd) for rrd in (False, True)] for _ in range(asked.rounds)]
    for plain, recorded in pairs:
        sys.stdout.write(
            f"{asked.tracker}, {asked.frames} frames: {plain[0]:.2f} and {recorded[0]:.2f} s a run, "
            f"{plain[1]:.2f} and {recorded[1]:.2f} CPU s, {plain[2]:.1f} and {recorded[2]:.1f} CPU ms a frame\n"
        )
    wall, whole, frame = (median(b[at] / a[at] - 1 for a, b in pairs) for at in (0, 1, 2))
    sys.stdout.write(
        f"median: wall {100 * wall:+.1f} %, processor {100 * whole:+.1f} %, a frame {100 * frame:+.1f} %\n"
    )


if __name__ == "__main__":
    main()
