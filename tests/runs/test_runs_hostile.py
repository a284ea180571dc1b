"""Trackers that exit, hang, leave processes or hoard memory, and faults around a run: one clear end, none survives."""

import errno
import json
import os
import pickle
import shlex
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Pipe
from pathlib import Path

import psutil
import pytest
from helpers import hostile
from helpers.hostile import alive
from helpers.waiting import until

from dynslam_bench.core import SHARED_MEMORY, InfrastructureError
from dynslam_bench.runs import Limits, RunRecord, RunSpec, RunStore, run_many, run_one
from dynslam_bench.runs.process import supervisor as memory_module
from dynslam_bench.runs.process.fork_server import (
    SERVERS,
    START_VARIABLE,
    Child,
    ForkServer,
)
from dynslam_bench.runs.process.process_trees import process_tree
from dynslam_bench.runs.process.supervisor import ServerDiedError, supervise

pytestmark = pytest.mark.slow

linux = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux' subreapers and /proc")


@pytest.fixture
def attack(store: RunStore, toy_folder: str, tmp_path: Path):
    """Runs the hostile tracker; gives the record and the processes that it started."""

    def run(mode: str, **limits: float) -> tuple[RunRecord, list[int]]:
        pids = tmp_path / "pids"
        spec = RunSpec(
            tracker=hostile.TARGET,
            sequence=toy_folder,
            frames=(0, 6),
            settings={"mode": mode, "pids": str(pids)},
            limits=Limits(**({"frame_s": 2.0} | limits)),
        )
        record = run_one(spec, store)
        return record, [int(line) for line in pids.read_text().split()] if pids.is_file() else []

    return run


@pytest.mark.parametrize(
    ("mode", "status", "reason"),
    [
        ("sys.exit", "crashed", "frame 2 of 6: sys.exit(0) was called (hostile.py:"),
        ("os._exit", "crashed", "the process left with exit code 0, after frame 1 of 6"),
        (
            "build-os._exit",
            "crashed",
            "the process left with exit code 0, before frame 0 was tracked of 6",
        ),
        ("hang", "timeout", "no sign of life for 1 s, after frame 1 of 6"),
        ("deaf", "timeout", "no sign of life for 1 s, after frame 1 of 6"),
        ("raise", "crashed", "frame 2 of 6: ValueError: too few points (hostile.py:"),
        ("thread", "ok", ""),
    ],
)
def test_every_bad_end_is_one_line(attack, mode: str, status: str, reason: str) -> None:
    record, _ = attack(mode, frame_s=1.0)
    assert record.status == status, record.reason
    assert record.reason.startswith(reason), record.reason
    assert "\n" not in record.reason


@linux
@pytest.mark.parametrize(
    ("start", "mode", "limits", "status", "count"),
    [
        ("fork", "children", {}, "ok", 3),
        ("fresh", "children", {}, "ok", 3),
        ("fork", "hog-child", {"memory_mb": 1000, "frame_s": 60}, "out-of-memory", 1),
    ],
)
def test_nothing_survives_a_run_that_ends_or_is_killed(
    attack, monkeypatch, start, mode, limits, status, count
) -> None:
    monkeypatch.setenv(START_VARIABLE, start)
    record, pids = attack(mode, **limits)
    assert (record.status, len(pids), alive(pids)) == (status, count, []), record.reason


@pytest.mark.parametrize("start", ["fork", "fresh"])
def test_a_run_has_its_parents_code_whatever_lies_in_the_working_folder_and_its_environment_of_now(
    attack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, start: str
) -> None:
    (tmp_path / "dynslam_bench").mkdir()
    for name in ("dynslam_bench/__init__.py", "runpy.py"):
        (tmp_path / name).write_text("raise SystemExit('another checkout')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    monkeypatch.setenv(START_VARIABLE, start)
    SERVERS[start].close()  # the next one starts in this folder, with the first value
    for value in ("1", None) if start == "fork" else ("1",):
        monkeypatch.delenv("DYNSLAM_BENCH_TESTED", raising=False)
        if value:
            monkeypatch.setenv("DYNSLAM_BENCH_TESTED", value)
        record, _ = attack("variable")
        assert f"ValueError: {value or 'not set'} " in record.reason


@linux
def test_memory_that_forks_share_counts_once(attack) -> None:
    """300 MB and three forks: four times as much by resident memory, which is not what the machine lacks."""
    plain, _ = attack("ok")
    assert plain.peak_memory_mb is not None
    record, pids = attack("shared", memory_mb=plain.peak_memory_mb + 700, frame_s=60)
    assert record.status == "ok", record.reason
    # a fork that ends while it is counted counts twice
    assert 300 < record.peak_memory_mb - plain.peak_memory_mb < 700
    assert len(pids) == 3
    assert alive(pids) == []


def test_the_default_memory_limit_is_a_share_of_the_machine(attack, monkeypatch) -> None:
    monkeypatch.setattr(memory_module, "machine_memory_mb", lambda: 1000.0)
    assert memory_module.memory_limit(None, 2) == (
        400.0,
        " (by default 80 % of this machine's 1000 MB, shared by 2 runs at a time)",
    )
    assert memory_module.memory_limit(0) == (None, "")
    assert memory_module.memory_limit(70.0, 4) == (70.0, "")
    record, _ = attack("hog-child", frame_s=60)
    assert record.status == "out-of-memory"
    assert (
        "the limit is 800 MB (by default 80 % of this machine's 1000 MB), after frame 1 of 6"
        in record.reason
    )


def test_a_flooded_log_keeps_its_ends(attack, store: RunStore) -> None:
    record, _ = attack("flood")
    log = (store.folder(record.run_id) / "log.txt").read_bytes()
    assert record.status == "ok"
    assert len(log) < 600_000
    assert log.startswith(b"the first line")
    assert log.endswith(b"the last line\n")
    assert log.count(b"was cut here") == 1


@linux
def test_the_parent_ends_and_all_end_with_it(
    store: RunStore, toy_folder: str, tmp_path: Path
) -> None:
    """The program is killed in mid-run, without a chance to clean up."""
    here = Path(hostile.__file__).parent
    settings = {"mode": "hog-child", "pids": str(tmp_path / "pids")}
    script = (
        f"import sys; sys.path[:0] = [{str(here)!r}, {str(here.parents[1])!r}]\n"
        "from dynslam_bench.runs import RunSpec, RunStore, run_one\n"
        f"store = RunStore({str(store.root)!r}); store.prepare()\n"
        f"spec = RunSpec(tracker={hostile.TARGET!r}, sequence={toy_folder!r}, frames=(0, 6), settings={settings!r})\n"
        "run_one(spec, store)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", script], cwd=tmp_path)
    until(lambda: (tmp_path / "pids").is_file() and (tmp_path / "pids").read_text().endswith("\n"))
    pids = [int(line) for line in (tmp_path / "pids").read_text().split()]
    assert alive(pids) == pids
    # the run's own process holds the store's claim, and ends after its child
    tree = below(psutil.Process(parent.pid))
    assert tree.issuperset(pids)
    parent.kill()
    parent.wait()
    until(lambda: alive([*tree]) == [])
    store.prepare()
    assert list(store.runs.iterdir()) == []


STRAYS = """
import json, os, signal, subprocess, sys, time
DEAF = "import signal, time; [signal.signal(s, signal.SIG_IGN) for s in (1, 2, 15)]; time.sleep(300)"
def start(**how):
    return subprocess.Popen([sys.executable, "-S", "-c", DEAF], stdin=subprocess.DEVNULL, **how).pid
for line in sys.stdin:
    request = json.loads(line)
    if request["op"] == "reset":
        with open(sys.argv[1] + ".frame", "w") as file:
            file.write(request["images"]["file"])
        pids = [os.getpid(), start(), start(start_new_session=True)]
        if os.fork() == 0:
            os.setsid()
            with open(sys.argv[1], "a") as file:
                file.writelines(f"{pid}\\n" for pid in [*pids, start(start_new_session=True, env={})])
            os._exit(0)
        os.wait()
        print(json.dumps({"ok": True}), flush=True)
    elif request["op"] == "track":
        if request["index"] == 2:
            time.sleep(300)
        pose = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
        print(json.dumps({"index": request["index"], "state": "ok", "T_world_cam": pose}), flush=True)
"""


@pytest.fixture
def strays(tmp_path: Path, toy_folder: str):
    """A run of a foreign program that hangs on frame 2, with children that hide; and the file with their numbers."""
    (tmp_path / "strays.py").write_text(STRAYS)
    command = shlex.join([sys.executable, str(tmp_path / "strays.py"), str(tmp_path / "pids")])
    spec = RunSpec(
        tracker=f"subprocess:{command}",
        sequence=toy_folder,
        frames=(0, 6),
        limits=Limits(frame_s=60),
    )
    return spec, tmp_path / "pids"


def started(pids: Path, count: int) -> list[int]:
    """The processes, once there are so many."""
    until(lambda: pids.is_file() and len(pids.read_text().splitlines()) >= count)
    return [int(line) for line in pids.read_text().split()]


@linux
def test_a_killed_server_takes_everything_along_and_its_run_is_repeated(
    strays, store: RunStore, monkeypatch
) -> None:
    """Nothing is left of either try; the second server dies with this run alone, which is taken for the cause."""
    spec, pids = strays
    trees: list[set[int]] = []

    def look(pid: int) -> list[psutil.Process]:
        tree = process_tree(pid)
        trees.append({process.pid for process in tree})
        return tree

    monkeypatch.setattr(memory_module, "process_tree", look)
    # a server that loads nothing is there again at once
    monkeypatch.setenv(START_VARIABLE, "fresh")
    with ThreadPoolExecutor(1) as pool:
        run = pool.submit(run_one, spec, store)
        for turn in (1, 2):
            seen = started(pids, 4 * turn)
            until(lambda: any(tree >= {*seen[-4:]} for tree in trees[:-1]))  # noqa: B023 (the supervisor knows them)
            (server,) = [top for top in psutil.Process().children() if seen[-4] in below(top)]
            server.kill()
            until(lambda: alive(seen) == [])  # noqa: B023
        record = run.result()
    assert len(seen) == 8
    assert record.status == "crashed"
    assert record.reason.startswith(
        "the fork server was killed twice, the second time with this run alone, "
    )
    assert [path.name for path in store.runs.iterdir()] == [record.run_id]


def below(process: psutil.Process) -> set[int]:
    """The numbers of all descendants of a process."""
    return {descendant.pid for descendant in process.children(recursive=True)}


def test_a_server_that_dies_before_the_run_begins_is_no_outcome(
    store: RunStore, toy_folder: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run had no chance to kill it."""
    tries: list[Child] = []

    def dies(child: Child, *_: object, **__: object) -> None:
        tries.append(child)
        child.close()
        raise ServerDiedError("")

    monkeypatch.setenv(START_VARIABLE, "fresh")
    monkeypatch.setattr("dynslam_bench.runs.running.supervise", dies)
    with pytest.raises(
        InfrastructureError, match="the fork server was ended from outside"
    ) as raised:
        run_one(hostile_spec(toy_folder, "ok"), store)
    assert len(tries) == 2
    assert raised.value.hint == "the run is not stored; the same command goes on from there"
    assert list(store.runs.iterdir()) == []
    assert str(pickle.loads(pickle.dumps(raised.value))) == str(raised.value)


class _Scripted(ForkServer):
    """A fork server that says what it is told to."""

    def spawn(self, child_fd: int) -> int:
        read_fd, self.says = os.pipe()
        return read_fd

    def say(self, **message: int) -> None:
        os.write(self.says, json.dumps(message).encode() + b"\n")


@pytest.mark.parametrize("is_told", [True, False])
def test_the_number_of_a_process_that_has_ended_is_not_killed(is_told: bool) -> None:
    """The system has given it to another process, which runs in a group of its own."""
    server = _Scripted("fork")
    child = Child(server)
    with subprocess.Popen(
        [sys.executable, "-S", "-c", "input()"], stdin=subprocess.PIPE, start_new_session=True
    ) as other:
        server.say(pid=other.pid)
        assert child.poll() is None
        assert child.pid == other.pid
        if is_told:
            server.say(pid=0)
        child.kill()
        assert child.pid == (0 if is_told else other.pid)
        other.communicate(b"\n")
    assert other.returncode == (0 if is_told else -signal.SIGKILL)
    server.say(exit=0)
    assert child.poll() == 0
    child.close()
    os.close(server.says)


@linux
def test_a_foreign_program_ends_with_its_limit_however_it_hides(strays, store: RunStore) -> None:
    spec, pids = strays
    record = run_one(spec.model_copy(update={"limits": Limits(frame_s=1.0)}), store)
    assert record.status == "timeout"
    assert len(started(pids, 4)) == 4
    assert alive(started(pids, 4)) == []


@linux
def test_shared_memory_goes_with_a_run_that_is_killed(strays, store: RunStore) -> None:
    spec, pids = strays
    frames = pids.with_suffix(".frame")
    seen: list[bool] = []

    def look() -> bool:
        if pids.is_file():
            seen.append(Path(frames.read_text()).is_file())
        return bool(seen)

    record = run_many([spec], results=store, cancelled=look)[0]
    frame = Path(frames.read_text())
    assert record.status == "stopped"
    assert seen == [True]
    assert frame.is_relative_to(SHARED_MEMORY)
    assert not frame.parent.exists()


@pytest.mark.parametrize(
    ("mode", "words"),
    [
        ("full", "No space left on device"),
        ("gone", "was removed"),
        ("gone-quietly", "was removed"),
        ("moved", "was removed"),
        ("made-again", "was removed"),
        ("log-gone", "was removed"),
    ],
)
def test_a_full_disk_or_a_removed_folder_is_no_outcome(
    mode: str, words: str, store: RunStore, toy_folder: str
) -> None:
    settings = {"mode": mode, "pids": str(store.root)}
    spec = RunSpec(tracker=hostile.TARGET, sequence=toy_folder, frames=(0, 6), settings=settings)
    with pytest.raises(InfrastructureError, match=words):
        run_one(spec, store)
    assert store.ids() == []


def hostile_spec(toy_folder: str, mode: str, **changes: object) -> RunSpec:
    return RunSpec(
        tracker=hostile.TARGET,
        sequence=toy_folder,
        frames=(0, 6),
        settings={"mode": mode},
        **changes,
    )


@pytest.mark.parametrize("mode", ["kill-parent", "end-parents-group"])
def test_a_tracker_may_not_end_the_processes_above_it(attack, mode: str) -> None:
    server = SERVERS["fork"]
    attack("ok")
    before = server._running
    record, _ = attack(mode)
    assert record.status == "crashed"
    assert record.reason.startswith(
        "frame 2 of 6: PermissionError: [Errno 1] a run may not signal process"
    )
    assert "(hostile.py:" in record.reason
    assert server._running == before
    assert before[1].poll() is None


def test_a_tracker_may_ask_whether_the_processes_above_it_are_there(attack) -> None:
    assert attack("ask-parent")[0].status == "ok"


def test_a_tracker_may_not_end_the_program(
    store: RunStore, toy_folder: str, tmp_path: Path
) -> None:
    """The program is a process of its own here: it would be this one that is killed."""
    here = Path(hostile.__file__).parent
    spec = hostile_spec(toy_folder, "kill-program").model_dump_json()
    script = (
        f"import sys; sys.path[:0] = [{str(here)!r}, {str(here.parents[1])!r}]\n"
        "from dynslam_bench.runs import RunSpec, RunStore, run_one\n"
        f"print(run_one(RunSpec.model_validate_json({spec!r}), RunStore({str(store.root)!r})).reason)\n"
    )
    program = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True
    )
    assert program.returncode == 0, program.stderr
    assert program.stdout.startswith("frame 2 of 6: AccessDenied")


@pytest.mark.parametrize(
    ("event", "target", "is_refused"),
    [
        ("os.kill", "parent", True),
        ("os.killpg", "parents group", True),
        ("os.kill", "minus parents group", True),
        ("os.kill", "everything", True),
        ("os.killpg", "everybody", True),
        ("os.kill", "own", False),
        ("os.killpg", "own group", False),
    ],
)
def test_which_signals_are_refused(event: str, target: str, is_refused: bool) -> None:
    """The call is announced as Python announces it, and not made: it could end this process."""
    script = f"""
import os, sys
sys.path[:0] = {[str(Path(hostile.__file__).parents[2])]!r}
from dynslam_bench.runs.process.child import spare_ancestors
os.setpgid(0, 0)
spare_ancestors()
group = os.getpgid(os.getppid())
targets = {{"parent": os.getppid(), "parents group": group, "minus parents group": -group, "everything": -1,
            "everybody": 1, "own": os.getpid(), "own group": 0}}
sys.audit({event!r}, targets[{target!r}], 0)
try:
    sys.audit({event!r}, targets[{target!r}], 9)
except PermissionError:
    print("refused")
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "refused\n" if is_refused else ""), done.stderr


@linux
@pytest.mark.parametrize("mode", ["c-kill-parent", "shell-kill-parent"])
def test_a_run_that_kills_the_fork_server_costs_itself_alone(
    store: RunStore, toy_folder: str, monkeypatch: pytest.MonkeyPatch, mode: str
) -> None:
    """Runs beside it are repeated; it is repeated once, with nothing beside it, and has crashed."""
    # a server that loads nothing is there again at once
    monkeypatch.setenv(START_VARIABLE, "fresh")
    others = [hostile_spec(toy_folder, "ok", seed=seed) for seed in range(4)]
    specs = [others[0], hostile_spec(toy_folder, mode), *others[1:]]
    records = list(run_many(specs, results=store, jobs=3))
    assert [record.status for record in records] == ["ok", "crashed", "ok", "ok", "ok"]
    assert records[1].reason == (
        "the fork server was killed twice, the second time with this run alone, after frame 1 of 6"
    )
    assert records[1].n_processed == 2
    assert sorted(store.ids()) == sorted(record.run_id for record in records)
    reused: list[str] = []
    run_many(specs, results=store, on_event=lambda event: reused.append(event.kind))
    assert reused == ["reused"] * 5


class _Slow:
    """A child that is ready late, as when the fork server still loads; then it does nothing."""

    pid = 0
    lost = ""

    def __init__(self, ready_after_s: float) -> None:
        self.connection, self.theirs = Pipe()
        self.status_fd, self._write_fd = os.pipe()
        self.members: list = []
        self.ready_at = time.monotonic() + ready_after_s
        self.is_ready = self.has_ended = False

    def poll(self) -> int | None:
        if not self.is_ready and time.monotonic() > self.ready_at:
            self.is_ready = True
            self.theirs.send_bytes(json.dumps({"type": "ready"}).encode())
        return 0 if self.has_ended else None

    def kill(self) -> None:
        self.has_ended = True

    def close(self) -> None:
        os.close(self.status_fd)
        os.close(self._write_fd)


def test_the_time_limit_begins_when_the_run_does(tmp_path: Path) -> None:
    began = time.monotonic()
    assert supervise(_Slow(1.0), {}, Limits(time_s=0.5)).status == "timeout"
    assert time.monotonic() - began > 1.5
    with pytest.raises(InfrastructureError, match=r"no process for the run within 0\.3 s"):
        supervise(_Slow(60), {}, Limits(time_s=0.1, start_s=0.3))


@pytest.mark.parametrize("has_locks", [True, False])
def test_several_on_one_folder_share_the_work_and_without_locks_lose_nothing(
    store: RunStore, toy_folder: str, monkeypatch: pytest.MonkeyPatch, has_locks: bool
) -> None:
    def flock(*_: object) -> None:
        raise OSError(errno.ENOLCK, "no locks available")

    if not has_locks:
        monkeypatch.setattr("fcntl.flock", flock)  # as on some network file systems
    specs = [
        RunSpec(tracker="never-move", sequence=toy_folder, frames=(0, 4), stride=s)
        for s in (1, 2, 3)
    ]
    made: list[str] = []

    def bench(_: int) -> list[RunRecord]:
        events = {
            "on_event": lambda event: (
                made.append(event.run_id) if event.kind == "finished" else None
            )
        }
        return list(run_many(specs, results=RunStore(store.root), **events))

    with ThreadPoolExecutor(3) as pool:
        first, second, third = pool.map(bench, range(3))
    assert {record.status for record in first} == {"ok"}
    assert len(set(made)) == len(store.ids()) == 3
    assert not has_locks or (len(made) == 3 and first == second == third)
    assert store.all()[1] == []
    assert not list(store.runs.glob(".*"))
