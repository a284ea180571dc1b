"""Kills and faults, counted: the command line is disturbed, then does the same again, and has to end as if undisturbed.

    python tests/benchmarks/kills.py operations [--every 1] [--fault kill full read-only gone]
    python tests/benchmarks/kills.py moments [--times 20]
    python tests/benchmarks/kills.py signals

`operations`: two runs through
`dynslam-bench bench` with a fault at every file operation of the parent (by `tests/core/faults.py`); the command
line is entered in a fork that has imported it before, and starts a fork server of its own. `moments`: `bench` and
`tune run` killed (SIGKILL, to the whole group) and interrupted (SIGINT) after random times. `signals`: a foreign
program that ignores signals and hides its children in sessions of their own, ended by each signal to the command line,
its group, the fork server, a keeper; how long until nothing is left.

Bars: every disturbed folder, gone on from, holds the same runs with the same trajectories; no traceback; all processes
gone within 2 s; nothing left in shared memory.
"""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

from command_line import parser_of

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), *(str(ROOT / "tests" / room) for room in ("core", "envs", "runs", "tuning"))]

from envs_toys import write_folder  # noqa: E402
from faults import Injector  # noqa: E402
from test_runs_hostile import STRAYS  # noqa: E402

from dynslam_bench.cli import main as main_of_the_command_line  # noqa: E402
from dynslam_bench.core.files import SHARED_MEMORY  # noqa: E402
from dynslam_bench.runs.process.fork_server import SERVERS, process_tree  # noqa: E402

SUITE = 'trackers = ["never-move", "constant-velocity"]\nsequences = ["{folder}"]\nframes = [0, 10]\n'
STUDY = 'tracker = "opencv-odometry"\ntune = ["{folder}"]\ntrials = 3\nseeds = [0]\noffsets = [0]\n'
LIGHT_SERVER = """#!/bin/sh
exec {python} -c "import sys; import dynslam_bench.runs.process.fork_server as server
server.PRELOADED = ('numpy', 'cv2', 'gymnasium', 'dynslam_bench.envs', 'dynslam_bench.runs.process.child')
server.serve(int(sys.argv[-2]), sys.argv[-1])" "$@"
"""
"""A fork server that has imported what the toys need, which is a third of what systems need."""


def environment() -> dict[str, str]:
    """With this checkout, and the faults, on the import path."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(sys.path[:5])}


def command(*arguments: str) -> list[str]:
    """The command line in this interpreter."""
    return [sys.executable, "-c", "from dynslam_bench.cli import main; main()", *arguments]


def outcome(results: Path) -> dict[str, tuple[str, str]]:
    """Status and trajectory of every stored run."""
    found = {}
    for record in sorted(results.glob("runs/[0-9a-f]*/run.json")):
        track = record.with_name("trajectory_online.txt").read_text().partition("\n")[2]
        found[record.parent.name] = (json.loads(record.read_text())["status"], track)
    return found


def go_on(work: Path, arguments: list[str], expected: object | None) -> tuple[object, str]:
    """Do it undisturbed; what is there, and what is wrong with that."""
    done = subprocess.run(command(*arguments), cwd=work, env=environment(), capture_output=True, text=True)
    there = outcome(work / "results")
    left = [path.name for path in (work / "results" / "runs").glob(".*") if path.suffix in (".tmp", ".claim")]
    if done.returncode:
        return there, f"exit code {done.returncode}: {done.stderr.strip()[-200:]}"
    if expected is not None and there != expected:
        return there, "other runs than undisturbed"
    return there, f"left: {left}" if left else ""


def operations(work: Path, which: list[str], every: int) -> Counter[str]:
    """A fault at every file operation of the parent of two runs."""
    (work / "suite.toml").write_text(SUITE.format(folder=write_folder(work / "toy", 20)))
    (work / "python").write_text(LIGHT_SERVER.format(python=sys.executable))
    (work / "python").chmod(0o755)
    sys.executable = str(work / "python")
    os.chdir(work)
    bench()  # here, so that no fork has to import what it needs
    SERVERS["fork"].close()
    expected = outcome(work / "results")
    counted: Counter[str] = Counter()
    _, total, said = disturb(work, 0, "kill")
    assert outcome(work / "results") == expected, said
    sys.stdout.write(f"{total} file operations\n")
    for fault in which:
        for at in range(1, total + 1, every):
            _, _, said = disturb(work, at, fault)
            if "Traceback" in said:
                sys.stdout.write(f"{fault} at {at}: traceback: {said.strip()[-300:]}\n")
                counted["tracebacks"] += 1
            code, _, said = in_fork(work, Injector(work / "results"))
            left = [path.name for path in (work / "results" / "runs").glob(".*") if path.suffix in (".tmp", ".claim")]
            wrong = f"exit code {code}: {said.strip()[-200:]}" if code else f"left: {left}" if left else ""
            wrong = wrong or ("" if outcome(work / "results") == expected else "other runs than undisturbed")
            note(counted, f"{fault} at {at}", wrong)
    return counted


def bench() -> int:
    """The command line, in this process; its exit code."""
    sys.argv = ["dynslam-bench", "bench", "suite.toml"]
    try:
        main_of_the_command_line()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def disturb(work: Path, at: int, fault: str) -> tuple[int, int, str]:
    """The command line on an empty results folder, with a fault at one file operation; 0 for none."""
    shutil.rmtree(work / "results")
    (work / "results").mkdir()
    return in_fork(work, Injector(work / "results", at, fault))


def in_fork(work: Path, injector: Injector) -> tuple[int, int, str]:
    """The command line in a fork: exit code, file operations, what it said on standard error."""
    said, counted = work / "said", work / "counted"
    counted.write_text("0")
    sys.stdout.flush()
    pid = os.fork()
    if pid == 0:
        os.setsid()
        os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        injector.install()
        try:
            code = bench()
        except BaseException:
            traceback.print_exc()
            code = 99
        sys.stdout.flush()
        SERVERS["fork"].close()
        counted.write_text(str(injector.count))
        os._exit(code)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    return code, int(counted.read_text()), said.read_text()


def moments(work: Path, times: int) -> Counter[str]:
    """Killed and interrupted after random times."""
    folder = write_folder(work / "toy", 30)
    (work / "suite.toml").write_text(SUITE.format(folder=folder))
    (work / "study.toml").write_text(STUDY.format(folder=folder))
    rng, counted = random.Random(0), Counter[str]()
    for arguments in (["bench", "suite.toml"], ["tune", "run", "study.toml"]):
        began = time.monotonic()
        shutil.rmtree(work / "results", ignore_errors=True)
        expected, wrong = go_on(work, arguments, None)
        assert not wrong, wrong
        whole = time.monotonic() - began
        for turn in range(times):
            number = (signal.SIGKILL, signal.SIGINT)[turn % 2]
            shutil.rmtree(work / "results", ignore_errors=True)
            after = rng.uniform(0.05, 1.0) * whole
            program = subprocess.Popen(
                command(*arguments), cwd=work, env=environment(), stderr=subprocess.PIPE, text=True,
                stdout=subprocess.DEVNULL, start_new_session=True,
            )  # fmt: skip
            time.sleep(after)
            if program.poll() is None:
                os.killpg(program.pid, number)
            _, said = program.communicate()
            if "Traceback" in said and program.returncode != -signal.SIGINT:  # Python itself was loading
                sys.stdout.write(f"{arguments[0]}, {number.name} after {after:.1f} s: {said.strip()[-300:]}\n")
                counted["tracebacks"] += 1
            _, wrong = go_on(work, arguments, expected if arguments[0] == "bench" else None)
            note(counted, f"{arguments[0]}, {number.name} after {after:.2f} of {whole:.1f} s", wrong)
    return counted


def signals(work: Path) -> Counter[str]:
    """A foreign program that hides its children, ended in every way."""
    folder = write_folder(work / "toy", 10)
    (work / "strays.py").write_text(STRAYS)
    counted: Counter[str] = Counter()
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL)
    cases = [(whom, number) for whom in ("command", "group") for number in numbers]
    for whom, number in [*cases, ("server", signal.SIGKILL), ("server", signal.SIGTERM), ("run", signal.SIGKILL)]:
        pids = work / f"pids.{whom}.{number.name}"
        tracker = f"subprocess:{sys.executable} {work / 'strays.py'} {pids}"
        program = subprocess.Popen(
            command("run", tracker, str(folder), "--frames", "0:6"), cwd=work, env=environment(),
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        while not (pids.is_file() and len(pids.read_text().split()) >= 4):
            time.sleep(0.05)
        mine = [int(line) for line in pids.read_text().split()]
        _, server, run, *_ = (process.pid for process in process_tree(program.pid))
        mine += [process.pid for process in process_tree(server if whom in ("command", "group") else run)]
        target = {"command": program.pid, "group": program.pid, "server": server, "run": run}[whom]
        (os.killpg if whom == "group" else os.kill)(target, number)
        took = until_gone(mine)
        if whom not in ("command", "group"):
            program.kill()
        code = program.wait()
        frame = Path(pids.with_suffix(f"{pids.suffix}.frame").read_text())
        wrong = (
            "" if took < 2 else f"alive after {took:.1f} s: {[pid for pid in mine if Path(f'/proc/{pid}').exists()]}"
        )
        if whom == "command" and number != signal.SIGKILL and code != 128 + number:
            wrong = f"exit code {code}"
        if not wrong and frame.parent.exists():
            wrong = f"{frame.parent} is left in {SHARED_MEMORY}"
        note(
            counted, f"{number.name} to the {whom}: {len(mine)} processes gone in {took:.2f} s, exit code {code}", wrong
        )
    return counted


def until_gone(pids: list[int]) -> float:
    """Seconds until none of the processes runs; 10 if some still do."""
    began = time.monotonic()
    while time.monotonic() - began < 10:
        if not any(_runs(pid) for pid in pids):
            break
        time.sleep(0.01)
    return time.monotonic() - began


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def note(counted: Counter[str], what: str, wrong: str) -> None:
    """Count and print."""
    counted["tried"] += 1
    counted["survived"] += not wrong
    sys.stdout.write(f"{what}: {wrong or 'fine'}\n")
    sys.stdout.flush()


def main() -> int:
    """Disturb, and print the counts."""
    parser = parser_of(__doc__, every=1, times=20, fault=["kill", "full", "read-only", "gone"])
    parser.add_argument("what", choices=("operations", "moments", "signals"))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="kills-") as folder:
        work = Path(folder)
        if options.what == "operations":
            counted = operations(work, options.fault, options.every)
        elif options.what == "moments":
            counted = moments(work, options.times)
        else:
            counted = signals(work)
    sys.stdout.write(f"{options.what}: {dict(counted)}\n")
    return 0 if counted["tried"] == counted["survived"] and not counted["tracebacks"] else 1


if __name__ == "__main__":
    raise SystemExit(main())
