"""How long does it take from nothing to one's own tracker on the leaderboard, by the documentation alone?

    python tests/benchmarks/first_tracker.py            # docs/start/tracker.md: a tracker in Python
    python tests/benchmarks/first_tracker.py cpp        # docs/start/tracker_cpp.md: one in C++
    python tests/benchmarks/first_tracker.py --install  # in a fresh virtual environment, whose making is timed apart

The commands are taken from the page's blocks up to its first `report`, in a new folder with empty caches (rendered
frames, compiled kernels), and must all succeed; then the leaderboard is asked whether the tracker is on it. The target
is ten minutes; what pip downloads depends on the network and is printed by itself. Processor seconds are printed, too:
on a loaded machine they alone mean something.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = {"python": ("docs/start/tracker.md", "My Slam"), "cpp": ("docs/start/tracker_cpp.md", "My C++ SLAM")}
BEGINNING = "docs/start/leaderboard.md"
TARGET_S = 600


def commands(page: str) -> list[str]:
    """The lines of a page's blocks of bash, without comments, up to the first report."""
    text = (ROOT / page).read_text(encoding="utf-8")
    blocks = re.findall(r"^```bash\n(.*?)^```", text, flags=re.S | re.M)
    lines = [line.partition("  #")[0].strip() for block in blocks for line in block.splitlines()]
    last = next(number for number, line in enumerate(lines) if line.startswith("dynslam-bench report"))
    return lines[: last + 1]


def installation() -> list[str]:
    """The first block of the page about installing; its environment is activated by the caller."""
    return [line for line in commands(BEGINNING) if "pip install" in line]


def processor_s() -> float:
    """Processor seconds of all commands so far."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def timed(line: str, folder: Path, environment: dict[str, str]) -> float:
    """Seconds that a command takes; a failing one ends everything."""
    started, used = time.monotonic(), processor_s()
    done = subprocess.run(["bash", "-c", line], cwd=folder, env=environment, capture_output=True, text=True)
    seconds = time.monotonic() - started
    if done.returncode:
        sys.exit(f"{line}\nexit code {done.returncode}\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    print(f"{seconds:8.1f} s  {processor_s() - used:8.1f} s of processors  {line}", flush=True)
    return seconds


def stands(label: str, folder: Path, environment: dict[str, str]) -> bool:
    """Whether the printed leaderboard names the tracker."""
    report = ["bash", "-c", "dynslam-bench report results"]
    told = subprocess.run(report, cwd=folder, env=environment, capture_output=True, text=True, check=True).stdout
    print(told)
    return label in told


def main() -> int:
    """Run the page's commands and compare with the target."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", nargs="?", choices=tuple(PAGES), default="python")
    parser.add_argument("--install", action="store_true", help="make a virtual environment first, as the page says")
    options = parser.parse_args()
    page, label = PAGES[options.kind]
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work, "mine")
        folder.mkdir()
        caches = {"XDG_CACHE_HOME": f"{work}/cache", "NUMBA_CACHE_DIR": f"{work}/kernels"}
        environment = {**os.environ, **caches, "PATH": f"{work}/bin:{os.environ['PATH']}"}
        for name in ("DYNSLAM_BENCH_DATA", "DYNSLAM_BENCH_CACHE"):
            environment.pop(name, None)
        if options.install:
            for line in installation():
                timed(line.replace(".venv", f"{work}/venv"), ROOT, environment)
            environment["PATH"] = f"{work}/venv/bin:{os.environ['PATH']}"
        else:
            program = Path(work, "bin", "dynslam-bench")
            program.parent.mkdir()
            program.write_text(f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} -m dynslam_bench "$@"\n')
            program.chmod(0o755)
        if options.kind == "cpp":  # the page begins in the clone
            (folder / "examples").symlink_to(ROOT / "examples")
        total = sum(timed(line, folder, environment) for line in commands(page))
        print(f"{total:8.1f} s  in all, of {TARGET_S}")
        return 0 if stands(label, folder, environment) and total <= TARGET_S else 1


if __name__ == "__main__":
    sys.exit(main())
