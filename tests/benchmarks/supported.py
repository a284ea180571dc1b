"""The package on every supported Python with the oldest and the newest versions of what it needs.

    python tests/benchmarks/supported.py [--python 3.10 3.11 3.12 3.13] [--versions newest oldest]
        [--install] [--tests tests] [--record FILE]

Needs `uv` (``pip install uv``). Each pair is resolved: there are versions of all dependencies that fit together for
that Python, the oldest of the direct ones being those that `pyproject.toml` names. The sources are compiled by that
Python where it is installed. With `--install` all is installed into a fresh environment, several GB with torch, and the
tests are run in it, as the project's workflow does.

Bar: every pair resolves, compiles and passes.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
RESOLUTION = {"newest": "highest", "oldest": "lowest-direct"}
SOURCES = ("dynslam_bench", "envs", "tuning", "reports", "tests")


def tried(python: str, versions: str, uv: str, tests: list[str], work: Path) -> dict[str, Any]:
    """What became of one pair: which versions, whether the sources compile, and the tests' last line."""
    needs = work / "needs.txt"
    resolve = ["pip", "compile", "-q", "--extra", "test", "--python-version", python, "--no-header", "--no-annotate"]
    found = call(uv, *resolve, "--resolution", RESOLUTION[versions], "-o", str(needs), str(ROOT / "pyproject.toml"))
    row: dict[str, Any] = {"python": python, "versions": versions, "resolved": found}
    if found == "fine":
        main = {"numpy", "torch", "opencv-python-headless", "optuna", "pandas", "pydantic", "scipy", "numba"}
        row["needs"] = [line for line in needs.read_text().split() if line.partition("==")[0] in main]
    interpreter = subprocess.run([uv, "python", "find", "--offline", python], capture_output=True, text=True)
    if interpreter.returncode == 0:
        compiled = ["-X", f"pycache_prefix={work}", "-m", "compileall", "-q", "-f", *(str(ROOT / s) for s in SOURCES)]
        row["compiled"] = call(interpreter.stdout.strip(), *compiled)
    if tests and found == "fine":
        row["tests"] = install_and_test(uv, python, needs, tests, work)
    return row


def install_and_test(uv: str, python: str, needs: Path, tests: list[str], work: Path) -> str:
    """``fine``, or the last line of what failed."""
    environment = work / "venv"
    inside = str(environment / "bin" / "python")
    for step in (
        [uv, "venv", "-q", "--python", python, str(environment)],
        [uv, "pip", "install", "-q", "--python", inside, "-r", str(needs)],
        [uv, "pip", "install", "-q", "--python", inside, "--no-deps", str(ROOT)],
        [inside, "-m", "pytest", "-q", *tests],
    ):
        done = call(*step)
        if done != "fine":
            return done
    return "fine"


def call(*command: str) -> str:
    """``fine``, or the last line of a command that failed."""
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    last = (done.stdout + done.stderr).strip().splitlines() or [""]
    return "fine" if done.returncode == 0 else f"exit code {done.returncode}: {last[-1][:200]}"


def main() -> int:
    """Print a line a pair, and write them down if a file is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", nargs="+", default=["3.10", "3.11", "3.12", "3.13"])
    parser.add_argument("--versions", nargs="+", choices=tuple(RESOLUTION), default=list(RESOLUTION))
    parser.add_argument("--install", action="store_true")
    parser.add_argument("--tests", nargs="+", default=["tests"])
    parser.add_argument("--record", type=Path)
    options = parser.parse_args()
    uv = shutil.which("uv")
    if uv is None:
        sys.stderr.write("uv is missing: pip install uv\n")
        return 2
    rows = []
    for python in options.python:
        for versions in options.versions:
            with tempfile.TemporaryDirectory(prefix="supported-") as folder:
                rows.append(tried(python, versions, uv, options.tests if options.install else [], Path(folder)))
            sys.stdout.write(json.dumps(rows[-1]) + "\n")
            sys.stdout.flush()
    if options.record:
        options.record.write_text(json.dumps(rows, indent=1) + "\n")
    return int(any(row.get(what, "fine") != "fine" for row in rows for what in ("resolved", "compiled", "tests")))


if __name__ == "__main__":
    raise SystemExit(main())
