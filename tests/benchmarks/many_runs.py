"""Many short runs in one session: memory, open files and processes of the session must not grow.

    python tests/benchmarks/many_runs.py [--runs 1000] [--jobs 2]

Prints what the session (this process, its fork server) holds every tenth of the way.

Bars: from the first tenth to the last, memory grows by less than 1 MB per 100 runs (the records that are returned
included), and open files, processes and temporary folders not at all.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "envs")]

from envs_toys import write_folder  # noqa: E402

from dynslam_bench.runs import RunSpec, RunStore, run_many  # noqa: E402
from dynslam_bench.runs.process.tree import family  # noqa: E402


def held() -> dict[str, float]:
    """What this session holds."""
    members = family(os.getpid())
    pages = [int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in members]
    folders = list(Path(tempfile.gettempdir()).glob("dynslam-held-*"))
    return {
        "memory_mb": sum(pages) * os.sysconf("SC_PAGE_SIZE") / 1e6,
        "files": sum(len(list(Path(f"/proc/{pid}/fd").iterdir())) for pid in members),
        "processes": len(members),
        "folders": len(folders),
    }


def main() -> int:
    """Print the growth."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    marks: list[dict[str, float]] = []
    step = max(1, options.runs // 10)
    with tempfile.TemporaryDirectory(prefix="many-runs-") as folder:
        tempfile.tempdir = os.environ["TMPDIR"] = str(Path(folder) / "temporary")  # of this session alone
        Path(tempfile.tempdir).mkdir()
        sequence = str(write_folder(Path(folder) / "toy", 10))
        store = RunStore(Path(folder) / "results")
        for begin in range(0, options.runs, step):
            specs = [
                RunSpec(tracker="never-move", sequence=sequence, frames=(0, 4), seed=seed)
                for seed in range(begin, min(begin + step, options.runs))
            ]
            failed = [record.reason for record in run_many(specs, results=store, jobs=options.jobs) if record.failed]
            assert not failed, failed
            marks.append(held())
            sys.stdout.write(f"after {begin + len(specs):5d} runs: {marks[-1]}\n")
            sys.stdout.flush()
    growth = {name: marks[-1][name] - marks[0][name] for name in marks[0]}
    per_hundred = 100 * growth["memory_mb"] / max(1, options.runs - step)
    sys.stdout.write(f"growth after the first tenth: {growth}, {per_hundred:.2f} MB per 100 runs\n")
    return 0 if per_hundred < 1 and max(growth[name] for name in ("files", "processes", "folders")) <= 0 else 1


if __name__ == "__main__":
    raise SystemExit(main())
