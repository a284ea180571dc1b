"""Workers of one study on several machines: which live, what becomes of their trials, a database that restarts."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import optuna
import pytest
import toy_tracker
from optuna.trial import TrialState
from simulated import SimulatedTuner, make_spec, valley
from sqlalchemy.exc import OperationalError

from dynslam_bench.core.errors import StudyError
from dynslam_bench.tuning import Study, StudySpec, run_study, storage
from dynslam_bench.tuning.storage import Heartbeats, PatientStorage, open_database, worker_name
from dynslam_bench.tuning.study import CRASHED_WORKER

WORKER = """
import sys
from dynslam_bench.tuning import StudySpec, run_study, storage
storage.HEARTBEAT_S, storage.GRACE_S = 0.5, 4.0
if __name__ == "__main__":
    run_study(StudySpec.model_validate_json(sys.argv[1]), results=sys.argv[2])
"""


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> StudySpec:
    root = tmp_path_factory.mktemp("toys")
    sequences = [str(toy_tracker.make_sequence(root / f"s{i}", 0.8 * i)) for i in range(2)]
    return StudySpec(
        name="toy", tracker=f"{toy_tracker.__file__}:SPEC", tune=sequences[:1], confirm=sequences[1:], trials=3,
        space={"include": ["gain"]}, offsets=[0], pruner="none", min_coverage=None, recorded=[],
    )  # fmt: skip


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storage, "HEARTBEAT_S", 0.1)
    monkeypatch.setattr(storage, "GRACE_S", 1.0)
    monkeypatch.setattr(storage, "NAMELESS_S", 0.5)
    monkeypatch.setattr("dynslam_bench.tuning.study._WAIT_S", 0.1)


def running(study: optuna.Study, worker: str) -> optuna.Trial:
    trial = study.ask()
    trial.set_user_attr("worker", worker)
    return trial


def test_a_worker_elsewhere_is_dead_once_it_counts_no_more(quick: None, monkeypatch: pytest.MonkeyPatch) -> None:
    study = optuna.create_study()
    alive, silent, nameless = running(study, "there:1"), running(study, f"there:{os.getpid()}"), study.ask()
    heartbeats = Heartbeats(study)
    with monkeypatch.context() as patch:
        patch.setattr(storage, "worker_name", lambda: "there:1")
        other = Heartbeats(study)

    def dead_after(seconds: float) -> set[int]:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            dead = {trial.number for trial in study.get_trials(deepcopy=False) if heartbeats.is_dead(trial)}
            time.sleep(0.1)
        return dead

    other.beat()
    with other.beating():
        assert dead_after(2.5) == {silent.number}, "the nameless trial may be that worker's"
    assert dead_after(2.5) == {alive.number, silent.number, nameless.number}


def test_running_trials_are_shown_with_their_workers(quick: None, monkeypatch: pytest.MonkeyPatch) -> None:
    study = optuna.create_study()
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    names = [worker_name(), f"{worker_name().rpartition(':')[0]}:{ended.pid}", "there:1", "there:2"]
    for name in names:
        running(study, name)
    heartbeats = Heartbeats(study)
    with monkeypatch.context() as patch:
        patch.setattr(storage, "worker_name", lambda: "there:1")
        other = Heartbeats(study)
    with other.beating():
        states = heartbeats.running()
    ends = zip(names, ("alive", "dead", "alive", "silent"), strict=True)
    assert states == {number: f"{name}, {end}" for number, (name, end) in enumerate(ends)}


def test_a_worker_here_is_dead_with_its_process() -> None:
    study = optuna.create_study()
    child = subprocess.Popen([sys.executable, "-c", ""])
    trials = [running(study, worker_name()), running(study, f"{worker_name().rpartition(':')[0]}:{child.pid}")]
    child.wait()
    heartbeats = Heartbeats(study)
    assert [heartbeats.is_dead(study.trials[trial.number]) for trial in trials] == [False, True]


def test_the_trial_of_a_worker_that_died_elsewhere_is_made_again(spec: StudySpec, tmp_path: Path, quick: None) -> None:
    lost = Study(spec, tmp_path).ask()
    lost.set_user_attr("worker", "elsewhere:7")
    trials = run_study(spec, results=tmp_path).study.get_trials()
    assert [trial.state for trial in trials] == [TrialState.FAIL, *[TrialState.COMPLETE] * 3]
    assert trials[0].user_attrs["reason"] == CRASHED_WORKER


@pytest.mark.parametrize("answers_after", [2, None])
def test_a_database_that_does_not_answer_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answers_after: int | None
) -> None:
    calls = iter(range(1000))

    def fails(database: object) -> list[object]:
        if answers_after is None or next(calls) < answers_after:
            raise OperationalError("SELECT", {}, Exception("connection refused"))
        return []

    monkeypatch.setattr(storage, "PATIENCE_S", 60.0 if answers_after else 0.0)
    monkeypatch.setattr(PatientStorage, "get_all_studies", storage._patient(fails))
    database = open_database(f"sqlite:///{tmp_path}/study.db")
    if answers_after:
        assert database.get_all_studies() == []
    else:
        with pytest.raises(StudyError, match=r"^the study's database does not answer: .*connection refused"):
            database.get_all_studies()


class Postgres:
    """A server of its own, run by a user without privileges."""

    def __init__(self, root: Path) -> None:
        self.root, self.user = root, "postgres" if os.getuid() == 0 else None
        if self.user:
            shutil.chown(root, self.user)
        self.run("initdb", "-D", str(root / "data"), "-U", "me", "--auth=trust")
        self.start()
        self.run("createdb", "-h", str(root), "-U", "me", "trials")
        self.url = f"postgresql+psycopg://me@/trials?host={root}"

    def run(self, program: str, *arguments: str) -> None:
        binary = next(Path("/usr/lib/postgresql").glob(f"*/bin/{program}"))
        subprocess.run([binary, *arguments], check=True, user=self.user, cwd=self.root, stdout=subprocess.DEVNULL)

    def start(self) -> None:
        log, options = str(self.root / "log"), f"-c listen_addresses= -c unix_socket_directories={self.root}"
        self.run("pg_ctl", "-D", str(self.root / "data"), "-l", log, "-o", options, "-w", "start")

    def stop(self) -> None:
        self.run("pg_ctl", "-D", str(self.root / "data"), "-m", "immediate", "stop")


@pytest.fixture
def postgres() -> Iterator[Postgres]:
    pytest.importorskip("psycopg", reason="the extra [postgres] is not installed")
    if not list(Path("/usr/lib/postgresql").glob("*/bin/initdb")):
        pytest.skip("Debian's postgresql is not installed")
    root = Path(tempfile.mkdtemp(prefix="pg"))  # a socket's path is short
    server = Postgres(root)
    yield server
    server.stop()
    shutil.rmtree(root)


def test_a_killed_worker_and_a_restarted_database_lose_no_trial(
    spec: StudySpec, tmp_path: Path, postgres: Postgres
) -> None:
    spec = spec.model_copy(update={"storage": postgres.url, "trials": 10})
    (tmp_path / "worker.py").write_text(WORKER)
    command = [sys.executable, str(tmp_path / "worker.py"), spec.model_dump_json()]
    elsewhere = ["unshare", "--uts", "--pid", "--fork", "--kill-child", "--mount-proc", "sh", "-c"]
    elsewhere.append('hostname "$0" && exec "$@"')
    if subprocess.run([*elsewhere, "other", "true"], check=False, capture_output=True).returncode:
        elsewhere = []  # namespaces need privileges
    workers = [
        subprocess.Popen(
            [*elsewhere, *([f"host{number}"] if elsewhere else []), *command, str(tmp_path / f"results{number}")],
            stderr=subprocess.PIPE, text=True, start_new_session=True,
        )
        for number in range(2)
    ]  # fmt: skip

    def finished() -> int:
        with_states = optuna.load_study(study_name="toy", storage=postgres.url).get_trials(deepcopy=False)
        return sum(trial.state.is_finished() for trial in with_states)

    def until(count: int) -> None:
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline:
            try:
                if finished() >= count:
                    return
            except KeyError:  # no study yet
                pass
            time.sleep(0.2)
        pytest.fail(f"{count} trials are not finished")

    try:
        until(2)
        os.killpg(workers[0].pid, signal.SIGKILL)
        until(4)
        postgres.stop()
        postgres.start()
        _, errors = workers[1].communicate(timeout=240)
    finally:
        for worker in workers:
            if worker.poll() is None:
                os.killpg(worker.pid, signal.SIGKILL)
    assert workers[1].returncode == 0 and "Traceback" not in errors, errors[-2000:]
    trials = optuna.load_study(study_name="toy", storage=postgres.url).get_trials()
    states = [trial.state for trial in trials]
    assert states.count(TrialState.COMPLETE) == 10
    assert all(trial.user_attrs["reason"] == CRASHED_WORKER for trial in trials if trial.state == TrialState.FAIL)
    assert len(trials) <= 12


def test_fifty_workers_of_one_database_lose_repeat_and_double_no_trial(tmp_path: Path, postgres: Postgres) -> None:
    spec = make_spec(trials=80, storage=postgres.url, pruner="none")

    def work(number: int) -> Study:
        return SimulatedTuner(spec, tmp_path / str(number), effect=valley, in_memory=False).run()

    with ThreadPoolExecutor(50) as pool:  # each with connections of its own; PostgreSQL takes 100 unless told otherwise
        studies = list(pool.map(work, range(50)))
    trials = studies[0].study.get_trials()
    assert [trial.number for trial in trials] == list(range(len(trials)))
    assert {trial.state for trial in trials} == {TrialState.COMPLETE}
    assert len({tuple(sorted(trial.params.items())) for trial in trials}) == len(trials)
    assert 80 <= len(trials) < 80 + 50, "workers that ask at the same time may each begin one more"
