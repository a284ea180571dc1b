"""The package on every supported Python with the oldest and the newest versions of what it needs.

    python tests/benchmarks/supported.py [--python 3.10 3.11 3.12 3.13] [--versions newest oldest]
        [--install [--tests tests]] [--into FOLDER] [--record FILE]

Needs `uv` (``pip install uv``). Each pair is resolved: there are versions of all dependencies that fit together for
that Python, the oldest of the direct ones being the first with a wheel for it since those that `pyproject.toml` names.
The sources are compiled by that Python where it is installed. With `--install` all is installed into a fresh
environment, several GB with torch, and used there as a newcomer would: `STEPS`. With `--tests` those tests are run
there, too, as the project's workflow does. `--into` keeps the environments, and takes those that are there.

Bar: every pair resolves, compiles and passes.
"""

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


TOY = "import sys; from pathlib import Path; from envs_toys import write_folder; write_folder(Path('toy'), 20)"
STUDY = """name = "s"
tracker = "orb-slam2"
tune = ["toy"]
trials = 2
seeds = [0]
offsets = [0]
"""
STEPS = {
    "import": ["python", "-c", "from dynslam_bench import envs, tuning, reports, runs"],
    "toy sequence": ["python", "-c", TOY],
    "run": ["dynslam-bench", "run", "constant-velocity", "toy", "--frames", "0:16"],
    "rendered run": ["dynslam-bench", "run", "orb-slam2", "synthetic/walking_xyz?frames=8"],
    "list": ["dynslam-bench", "runs", "list"],
    "study": ["dynslam-bench", "tune", "run", "study.toml"],
    "report": ["dynslam-bench", "report"],
}
"""What is done with an installed package, one after the other."""


def tried(python: str, versions: str, uv: str, install: Path | None, tests: list[str], work: Path) -> dict[str, Any]:
    """What became of one pair: which versions, whether the sources compile, and what ran."""
    needs = work / "needs.txt"
    resolve = ["pip", "compile", "-q", "--only-binary", ":all:", "--extra", "test", "--python-version", python]
    resolve += ["--no-header", "--no-annotate"]
    found = call(uv, *resolve, "--resolution", RESOLUTION[versions], "-o", str(needs), str(ROOT / "pyproject.toml"))
    row: dict[str, Any] = {"python": python, "versions": versions, "resolved": found}
    if found == "fine":
        main = {"numpy", "torch", "opencv-python-headless", "optuna", "pandas", "pydantic", "scipy", "numba"}
        row["needs"] = [line for line in needs.read_text().split() if line.partition("==")[0] in main]
    interpreter = subprocess.run([uv, "python", "find", "--offline", python], capture_output=True, text=True)
    if interpreter.returncode == 0:
        compiled = ["-X", f"pycache_prefix={work}", "-m", "compileall", "-q", "-f", *(str(ROOT / s) for s in SOURCES)]
        row["compiled"] = call(interpreter.stdout.strip(), *compiled)
    if install is not None and found == "fine":
        row["ran"] = install_and_use(uv, python, needs, install / f"{python}-{versions}", tests, work)
    return row


def install_and_use(
    uv: str, python: str, needs: Path, environment: Path, tests: list[str], work: Path
) -> dict[str, str]:
    """By step, ``fine`` or the last line of what failed; nothing follows a failed installation."""
    inside = environment / "bin"
    install = ["pip", "install", "-q", "--python", str(inside / "python")]
    steps = [
        *([] if inside.is_dir() else [[uv, "venv", "-q", "--python", python, str(environment)]]),
        [uv, *install, "-r", str(needs)],
        [uv, *install, "--no-deps", "--reinstall", str(ROOT)],
    ]
    done = next((said for step in steps if (said := call(*step)) != "fine"), "fine")
    ran = {"installed": done}
    if done == "fine":
        (work / "study.toml").write_text(STUDY)
        os.environ |= {"PYTHONPATH": str(ROOT / "tests" / "envs"), "DYNSLAM_BENCH_CACHE": str(work / "cache")}
        os.environ |= {"NUMBA_CACHE_DIR": str(work / "kernels")}
        ran |= {name: call(str(inside / program), *rest, cwd=work) for name, (program, *rest) in STEPS.items()}
        if tests:
            ran["tests"] = call(str(inside / "python"), "-m", "pytest", "-q", *tests)
    return ran


def call(*command: str, cwd: Path = ROOT) -> str:
    """``fine``, or the last line of a command that failed."""
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    last = (done.stdout + done.stderr).strip().splitlines() or [""]
    return "fine" if done.returncode == 0 else f"exit code {done.returncode}: {last[-1][:200]}"


def main() -> int:
    """Print a line a pair, and write them down if a file is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", nargs="+", default=["3.10", "3.11", "3.12", "3.13"])
    parser.add_argument("--versions", nargs="+", choices=tuple(RESOLUTION), default=list(RESOLUTION))
    parser.add_argument("--install", action="store_true")
    parser.add_argument("--into", type=Path, help="keep the environments there")
    parser.add_argument("--tests", nargs="+", default=[])
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
                install = (options.into or Path(folder)).absolute() if options.install else None
                rows.append(tried(python, versions, uv, install, options.tests, Path(folder)))
            sys.stdout.write(json.dumps(rows[-1]) + "\n")
            sys.stdout.flush()
    if options.record:
        options.record.write_text(json.dumps(rows, indent=1) + "\n")
    ends = [end for row in rows for end in (row["resolved"], row.get("compiled", "fine"), *row.get("ran", {}).values())]
    return int(set(ends) != {"fine"})


if __name__ == "__main__":
    raise SystemExit(main())
