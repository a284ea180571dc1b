"""Kills commands at random moments, repeats them, and compares what they give with what they give undisturbed.

    python tests/benchmarks/kills.py [--kills 10] [--seed 0] [--commands bench tune report merge
    bank import gate]

Each command does a small job: runs of a toy tracker on recordings of 12 images of 16 x 12 pixels.
It is done once undisturbed. Then, so many times, it begins again in an empty folder; its process
group gets SIGKILL when its result has come as far as a random number says, and a random moment
later; and the same command is given again. A command that ends before its kill is drawn again. The
table gives the kills in the middle (some of the result was there, and not all), how many commands
went on, with exit code 0, and how many gave an equal result: statuses, checksums of trajectories
and errors of runs, imported ones too; trials, candidates and preset of a study; the files of a
report, of merged results and of a bank; the baseline of a gate. Times of the machine are not
compared. The exit code is 1 unless all results
are equal.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import cv2
import numpy as np
from command_line import parser_of

from dynslam_bench.core.plugins import module_command
from dynslam_bench.gate.baseline import BASELINE_FILE
from dynslam_bench.geometry import Camera
from dynslam_bench.runs import RunStore
from dynslam_bench.sequences.cameras import write_camera
from dynslam_bench.tuning import Study

TRACKER = '''
"""Reads the camera's place from the depth, scales it, and adds noise."""

import time

import numpy as np

from dynslam_bench.contracts import TrackerSpec, TrackResult
from dynslam_bench.core.settings import Settings, tunable


class DriftingSettings(Settings):
    gain: float = tunable(1.5, low=0.2, high=3.0, scale="log", meaning="scale of the motion; 1 is right")
    wobble: int = tunable(2, low=0, high=8, meaning="noise", unit="mm")


class Drifting:
    def __init__(self, settings):
        self.settings = settings

    def reset(self, camera, *, rng):
        self.rng = rng

    def track(self, frame):
        time.sleep(0.02)  # so that kills meet runs and not the beginning of the program alone
        pose = np.eye(4)
        pose[0, 3] = self.settings.gain * (float(frame.depth[0, 0]) - 1.0)
        pose[:3, 3] += self.rng.normal(0, 1e-3 * self.settings.wobble, 3)
        return TrackResult(pose, "ok")


SPEC = TrackerSpec(id="drifting", entry_point=f"{__file__}:Drifting", label="Drifting", settings=DriftingSettings)
'''
SUITE = """
trackers = ["never-move", {tracker}]
sequences = {sequences}
seeds = [0, 1]
"""
GATE = """
trackers = ["{tracker}"]
sequences = {sequences}
"""
STUDY = """
tracker = {tracker}
tune = {tune}
confirm = {confirm}
held_out = {held_out}
recorded = []
offsets = [0]
trials = 6
top = 2
sampler = "tpe"
min_coverage = 0.0

[space]
include = ["gain", "wobble"]
"""


JOURNAL = Path("studies/study/journal.log")
NEED_RUNS = {"report", "merge", "bank"}
"""The commands whose input are stored runs."""
LOOK_S = 0.001
"""Seconds between two looks at how far a result has come."""


def make_sequence(folder: Path, phase: float, frames: int = 12) -> Path:
    """A folder in TUM layout whose camera swings along x; the depth of the first pixel tells where it is."""
    lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for index in range(frames):
        x = 0.2 * np.sin(0.7 * index + phase)
        stamp = 100 + index / 30
        images = {
            "rgb": np.full((12, 16, 3), 10 * index, np.uint8),
            "depth": np.full((12, 16), round(5000 * (1 + x)), np.uint16),
        }
        for kind, image in images.items():
            (folder / kind).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / kind / f"{index}.png"), image)
            lists[kind].append(f"{stamp:.6f} {kind}/{index}.png")
        lists["groundtruth"].append(f"{stamp:.6f} {x:.6f} 0 0 0 0 0 1")
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    camera = Camera(16, 12, 15.0, 15.0, 7.5, 5.5, depth_factor=5000.0)
    write_camera(folder / "camera.toml", camera)
    return folder


# -- what a command gives, without the times of the machine


def runs_of(results: Path) -> list[Any]:
    """Statuses, checksums of files and errors of all runs."""
    store = RunStore(results)
    records, unreadable = store.all()
    rows: list[Any] = [str(entry) for entry in unreadable]
    for record in sorted(records, key=lambda record: record.run_id):
        rows.append(
            [record.run_id, record.status, record.reason, record.notes, record.files, record.study]
        )
        rows.append(store.score(record).model_dump(mode="json"))
    return rows


def study_of(results: Path) -> list[Any]:
    """Trials, candidates and preset of the study, and the runs that it made."""
    folder = (results / JOURNAL).parent
    stored = Study.open(folder)
    trials = [
        [trial.number, trial.state.name, trial.params, trial.values, trial.intermediate_values]
        for trial in stored.study.get_trials()
    ]
    summary = json.loads((folder / "summary.json").read_text())
    for candidate in summary["candidates"]:
        candidate.pop("scene_s", None)
        for name in ("on_confirm", "on_held_out"):
            candidate[name].pop("speed", None)
    return [trials, summary, (folder / "best.toml").read_text(), runs_of(results)]


_MADE_ON = re.compile(rb"on \d{4}-\d\d-\d\d \d\d:\d\d UTC")


def files_of(folder: Path) -> dict[str, bytes | str]:
    """All files, and where links lead; without the index of scores and the time at which a page was made."""
    contents: dict[str, bytes | str] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            contents[name] = str(path.readlink())
        elif path.is_file() and path.name != "index.sqlite":
            contents[name] = _MADE_ON.sub(b"", path.read_bytes())
    return contents


def baseline_of(folder: Path) -> list[Any]:
    """The errors, coverages and checksums of a gate's baseline."""
    baseline = json.loads((folder / BASELINE_FILE).read_text())
    rows = []
    for measurement in baseline["runs"]:
        del measurement["frame_time_s"]
        del measurement["memory_mb"]
        rows.append(measurement)
    return [baseline["question"], rows]


# -- commands


@dataclass
class Command:
    """A command and how its result is read.

    Attributes:
        words: Words of the command line; ``{target}`` is the folder that it writes.
        read: Gives its result.
        within: The folder in which it is given; None for the one that holds the target.
    """

    words: list[str]
    read: Callable[[Path], Any]
    within: Path | None = None

    def start(self, target: Path) -> subprocess.Popen[bytes]:
        """Start it in a process group of its own."""
        words = [word.format(target=target) for word in self.words]
        command = [*module_command("dynslam_bench"), *words]
        log = target.with_suffix(".log").open("wb")
        with log:
            return subprocess.Popen(
                command,
                cwd=self.within or target.parent,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def finish(self, target: Path) -> int:
        """Give it, wait for its end, and give its exit code."""
        return self.start(target).wait()


def make_commands(folder: Path, names: list[str]) -> dict[str, Command]:
    """The commands, on inputs that are made below a folder: those that the named commands need."""
    sequences = [str(make_sequence(folder / f"s{number}", 0.5 * number)) for number in range(4)]
    (folder / "drifting.py").write_text(TRACKER)
    tracker = json.dumps(f"{folder / 'drifting.py'}:SPEC")
    suite = folder / "suite.toml"
    study = folder / "study.toml"
    suite.write_text(SUITE.format(tracker=tracker, sequences=json.dumps(sequences[:2])))
    study.write_text(
        STUDY.format(
            tracker=tracker,
            tune=json.dumps(sequences[:2]),
            confirm=json.dumps(sequences[2:3]),
            held_out=json.dumps(sequences[3:]),
        )
    )
    bench = Command(["bench", str(suite), "--results", "{target}"], runs_of)
    repository = make_repository(folder / "repository", sequences[:2])
    # stored runs take minutes to make
    results = folder / "results"
    shards = [str(folder / f"shard{number}") for number in range(2)]
    if not NEED_RUNS.isdisjoint(names):
        assert bench.finish(results) == 0, results.with_suffix(".log").read_text()
        split(results, shards)
    return {
        "bench": bench,
        "tune": Command(["tune", "run", str(study), "--results", "{target}"], study_of),
        "report": Command(["report", str(results), "-o", "{target}"], files_of),
        "merge": Command(["runs", "merge", *shards, "-o", "{target}"], files_of),
        "bank": Command(["bank", "add", *shards, "{target}"], files_of),
        "import": Command(
            [
                *("import", f"{sequences[0]}/groundtruth.txt", "--tracker", "elsewhere"),
                *("--sequence", sequences[0], "--results", "{target}"),
            ],
            runs_of,
        ),
        "gate": Command(
            [
                *("gate", "record", "--baseline", f"{{target}}/{BASELINE_FILE}"),
                *("--results", "{target}/gate"),
            ],
            baseline_of,
            within=repository,
        ),
    }


def make_repository(folder: Path, sequences: list[str]) -> Path:
    """A git repository with a tracker and the question of a gate."""
    folder.mkdir()
    (folder / "drifting.py").write_text(TRACKER)
    question = GATE.format(tracker="drifting.py:SPEC", sequences=json.dumps(sequences))
    (folder / "gate.toml").write_text(question)
    author = ["-c", "user.name=Kills", "-c", "user.email=kills@example.org"]
    for words in (["init", "-q"], ["add", "."], [*author, "commit", "-q", "-m", "Add a tracker"]):
        subprocess.run(["git", *words], cwd=folder, check=True)
    return folder


def split(results: Path, shards: list[str]) -> None:
    """Copy the runs of one results folder into several, each of which gets its share."""
    run_ids = RunStore(results).ids()
    for number, shard in enumerate(map(Path, shards)):
        shutil.copytree(results / "sequences", shard / "sequences")
        for run_id in run_ids[number :: len(shards)]:
            shutil.copytree(results / "runs" / run_id, shard / "runs" / run_id)


# -- kills


@dataclass
class Tally:
    """What came of the kills of one command.

    Attributes:
        name: The command.
        undisturbed_s: How long it takes.
        kills: How many there were.
        middle: How many left some of the result, and not all.
        went_on: How often the same command then ended with exit code 0.
        equal: How often its result was that of the undisturbed one.
    """

    name: str
    undisturbed_s: float = 0.0
    kills: int = 0
    middle: int = 0
    went_on: int = 0
    equal: int = 0

    def row(self) -> str:
        """A row of the table."""
        outcome = f"{self.kills} | {self.middle} | {self.went_on} | {self.equal}"
        return f"| {self.name} | {self.undisturbed_s:.1f} | {outcome} |"


def progress(target: Path) -> int:
    """How far a result has come: its files and folders, unfinished ones too, and the lines of a study's journal."""
    lines = 0
    with suppress(OSError):
        lines = (target / JOURNAL).read_bytes().count(b"\n")
    return lines + sum(len(folders) + len(files) for _, folders, files in os.walk(target))


def kill_when(program: subprocess.Popen[bytes], target: Path, count: int, delay_s: float) -> bool:
    """Kill a program's group, so long after its result has come so far; False if it ends before."""
    while program.poll() is None and progress(target) < count:
        time.sleep(LOOK_S)
    with suppress(subprocess.TimeoutExpired):
        program.wait(delay_s)
    if program.poll() is not None:
        return False
    os.killpg(program.pid, signal.SIGKILL)
    program.wait()
    return True


def kill_and_repeat(name: str, command: Command, folder: Path, kills: int, random: Random) -> Tally:
    """Kill a command so many times, each time in an empty folder, and repeat it; what is wrong goes to stderr."""
    tally = Tally(name)

    # undisturbed: its result, how far it comes, and what a step takes
    target = folder / name  # always the same: a report shows the command that makes it
    began = time.time()
    assert command.finish(target) == 0, target.with_suffix(".log").read_text()
    tally.undisturbed_s = time.time() - began
    # a copy has the time of content of its original
    times = [path.lstat().st_ctime for path in target.rglob("*")]
    end = progress(target)
    step_s = (max(times) - min(times)) / end
    count = len(files_of(target))
    expected = command.read(target)
    shutil.rmtree(target)

    while tally.kills < kills:
        so_far = random.randrange(end)
        delay_s = random.uniform(0.0, step_s)
        if not kill_when(command.start(target), target, so_far, delay_s):
            shutil.rmtree(target, ignore_errors=True)
            continue
        tally.kills += 1
        left = len(files_of(target)) if target.is_dir() else 0
        tally.middle += 0 < left < count

        # the same command again
        code = command.finish(target)
        log = target.with_suffix(".log").read_text().strip()
        where = f"{name}, killed {delay_s:.3f} s after {so_far} of {end}, with {left} of {count} files there"
        if code:
            print(f"{where}: exit code {code}: {log[-500:]}", file=sys.stderr, flush=True)
        else:
            tally.went_on += 1
            result = command.read(target)
            tally.equal += result == expected
            if result != expected:
                print(f"{where}: {difference(expected, result)}", file=sys.stderr, flush=True)
        shutil.rmtree(target)
    return tally


def difference(expected: Any, result: Any) -> str:
    """The first place where two results differ, in words."""
    if isinstance(expected, dict) and isinstance(result, dict):
        names = [
            name for name in sorted({*expected, *result}) if expected.get(name) != result.get(name)
        ]
        return f"{names[0]}: {difference(expected.get(names[0]), result.get(names[0]))}"
    if isinstance(expected, list) and isinstance(result, list) and len(expected) == len(result):
        at = next(
            at for at, pair in enumerate(zip(expected, result, strict=True)) if pair[0] != pair[1]
        )
        return f"[{at}] {difference(expected[at], result[at])}"
    one = str(expected)
    other = str(result)
    differing = (at for at, pair in enumerate(zip(one, other, strict=False)) if pair[0] != pair[1])
    at = next(differing, min(len(one), len(other)))
    part = slice(max(0, at - 50), at + 100)
    return f"{one[part]!r} undisturbed, {other[part]!r} after the kill"


def main() -> int:
    """Print the table."""
    names = ["bench", "tune", "report", "merge", "bank", "import", "gate"]
    options = parser_of(__doc__, kills=10, seed=0, commands=names).parse_args()
    print(
        "| command | undisturbed, s | kills | in the middle | went on | equal results |\n"
        + "| --- " * 6
        + "|"
    )
    with tempfile.TemporaryDirectory() as folder:
        commands = make_commands(Path(folder), options.commands)
        tallies = []
        for name in options.commands:
            random = Random(f"{options.seed} {name}")
            tallies.append(
                kill_and_repeat(name, commands[name], Path(folder), options.kills, random)
            )
            print(tallies[-1].row(), flush=True)
    kills = sum(tally.kills for tally in tallies)
    equal = sum(tally.equal for tally in tallies)
    print(
        f"\n{equal} of {kills} commands that were killed gave, when repeated, the result of an undisturbed one."
    )
    return 0 if equal == kills else 1


if __name__ == "__main__":
    sys.exit(main())
