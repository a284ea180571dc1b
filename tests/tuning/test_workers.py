"""Workers of one study on several machines: which live, what becomes of their trials, a database that restarts."""

from __future__ import annotations

import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import optuna
import pytest
from hostile import until
from optuna.trial import FrozenTrial, TrialState
from simulated import SimulatedTuner, make_spec, nothing, toy_spec, valley
from sqlalchemy.exc import OperationalError

from dynslam_bench.core.errors import StudyError
from dynslam_bench.tuning import ProblemInstance, Study, Verdict, finish, parse_instances, storage
from dynslam_bench.tuning.objectives import ACCURACY
from dynslam_bench.tuning.storage import Heartbeats, PatientStorage, open_database, worker_name
from dynslam_bench.tuning.study import CRASHED_WORKER, StudyEvent

WORKER = """
import sys
from dynslam_bench.tuning import StudySpec, run_study, storage
storage.HEARTBEAT_S, storage.GRACE_S = 0.5, 4.0
if __name__ == "__main__":
    run_study(StudySpec.model_validate_json(sys.argv[1]), results=sys.argv[2])
"""


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


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> Callable[[optuna.Study], Heartbeats]:
    """Makes the heartbeats of another machine's worker."""

    def made(study: optuna.Study) -> Heartbeats:
        with monkeypatch.context() as patch:
            patch.setattr(storage, "worker_name", lambda: "there:1")
            return Heartbeats(study)

    return made


@pytest.mark.usefixtures("quick")
def test_a_worker_elsewhere_is_dead_once_it_counts_no_more(elsewhere: Callable[[optuna.Study], Heartbeats]) -> None:
    study = optuna.create_study()
    alive, silent, nameless = running(study, "there:1"), running(study, f"there:{os.getpid()}"), study.ask()
    heartbeats, other = Heartbeats(study), elsewhere(study)

    def dead_after(seconds: float) -> set[int]:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            dead = {trial.number for trial in study.get_trials(deepcopy=False) if heartbeats.is_dead(trial)}
            time.sleep(0.1)
        return dead

    other.beat()
    with other.beating():
        assert dead_after(2.0) == {silent.number}, "the nameless trial may be that worker's"
    assert dead_after(2.0) == {alive.number, silent.number, nameless.number}


@pytest.mark.usefixtures("quick")
def test_running_trials_are_shown_with_their_workers(
    dead: str, elsewhere: Callable[[optuna.Study], Heartbeats]
) -> None:
    study = optuna.create_study()
    names = [worker_name(), dead, "there:1", "there:2"]
    for name in names:
        running(study, name)
    with elsewhere(study).beating():
        states = Heartbeats(study).running()
    ends = zip(names, ("alive", "dead", "alive", "silent"), strict=True)
    assert states == {number: f"{name}, {end}" for number, (name, end) in enumerate(ends)}


@pytest.mark.parametrize("answers_after", [1, None])
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
    folders: list[str], tmp_path: Path, postgres: Postgres
) -> None:
    spec = toy_spec(tune=folders[:1], confirm=folders[1:2], storage=postgres.url, trials=10)
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
        with suppress(KeyError):  # no study yet
            with_states = optuna.load_study(study_name="toy", storage=postgres.url).get_trials(deepcopy=False)
            return sum(trial.state.is_finished() for trial in with_states)
        return 0

    try:
        until(lambda: finished() >= 2)
        os.killpg(workers[0].pid, signal.SIGKILL)
        until(lambda: finished() >= 4)
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


def ran_on(trial: FrozenTrial) -> list[ProblemInstance]:
    return [parse_instances(text)[0] for text, *_ in trial.user_attrs["instances"]]


@pytest.mark.parametrize("pruner", ["halving", "wilcoxon"])
def test_values_are_of_the_instances_that_ran(pruner: str, tmp_path: Path) -> None:
    tuner = SimulatedTuner(make_spec(pruner=pruner, trials=16), tmp_path, effect=valley)
    trials = tuner.run().study.get_trials()
    assert trials[0].state == TrialState.COMPLETE and {trial.state for trial in trials[1:]} >= {TrialState.PRUNED}
    for trial in trials:
        instances = ran_on(trial)
        value = ACCURACY.value(tuner.outcomes(tuner.configuration_of(trial).settings, instances), tuner.reference())
        if trial.state == TrialState.COMPLETE:
            assert instances == list(tuner.design.tune), "a value is one of all instances"
            assert trial.values[0] == pytest.approx(value, abs=1e-12)
        else:
            assert trial.state == TrialState.PRUNED and 3 <= len(instances) < len(tuner.design.tune)
            assert len(trial.intermediate_values) == len(instances)
            if pruner == "halving":
                assert trial.value == pytest.approx(value, abs=1e-12) and len(instances) in (3, 6, 12)


def test_trials_of_several_objectives_run_on_all_instances(tmp_path: Path) -> None:
    tuner = SimulatedTuner(make_spec(objectives=["accuracy", "speed"]), tmp_path, effect=valley).run()
    assert {len(ran_on(trial)) for trial in tuner.study.get_trials()} == {len(tuner.design.tune)}


def test_pruning_takes_half_the_runs_at_the_same_regret(tmp_path: Path) -> None:
    def cost(pruner: str) -> tuple[int, float]:
        specs = [make_spec(pruner=pruner, trials=24, sampler_seed=seed) for seed in range(3)]
        folder = tmp_path / pruner
        tuners = [SimulatedTuner(s, folder / str(n), effect=valley, seed=n).run() for n, s in enumerate(specs)]
        regrets = [valley(tuner.study.best_trial.params) for tuner in tuners]
        return sum(tuner.runs for tuner in tuners), float(np.mean(regrets))

    (whole, best), (pruned, regret) = cost("none"), cost("halving")
    assert pruned <= 0.5 * whole and regret <= best + 0.01


def test_nothing_is_claimed_where_nothing_is_better(tmp_path: Path) -> None:
    """Twelve studies; tests/benchmarks/study_null.py has more. The trials alone would claim a gain in most of them."""
    tuners = [SimulatedTuner(make_spec(sampler_seed=n), tmp_path / str(n), effect=nothing, seed=n) for n in range(12)]
    lucky = sum(tuner.run().study.best_value < math.log(0.95) for tuner in tuners)
    summaries = [finish(tuner) for tuner in tuners]
    verdicts = [summary.verdict for summary in summaries]
    assert verdicts.count(Verdict.PROVEN) == 0 and verdicts.count(Verdict.NO_MATTER) >= 9
    assert sum(summary.candidates[0].chosen for summary in summaries) <= 2, "5 % of 12, and its chance"
    assert lucky >= 5, "what the trials alone say"


def test_eight_workers_and_a_resume_repeat_no_trial(tmp_path: Path) -> None:
    def work(count: int) -> SimulatedTuner:
        spec = make_spec(trials=count, sampler="tpe")
        return SimulatedTuner(spec, tmp_path, effect=valley, in_memory=False).run()

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, [32] * 8))
    tuner = work(40)  # one of them goes on later
    drawn = [tuple(sorted(trial.params.items())) for trial in tuner.study.get_trials()]
    assert len(set(drawn)) == len(drawn) == 40
    assert drawn[0] == (("gain", 1.5), ("wobble", 2)), "the default, once"
    journal = optuna.storages.journal.JournalFileBackend(str(tuner.folder / "journal.log"))
    study = optuna.load_study(study_name="simulated", storage=optuna.storages.JournalStorage(journal))
    assert study.best_value == tuner.study.best_value and study.metric_names == ["accuracy"]
    assert any(trial.intermediate_values for trial in study.trials), "for Optuna's dashboard"


@pytest.fixture
def dead() -> str:
    """The name of a worker that has ended."""
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    return f"{worker_name().rpartition(':')[0]}:{ended.pid}"


def test_a_trial_of_a_dead_worker_is_repeated(tmp_path: Path, dead: str) -> None:
    tuner, other = (SimulatedTuner(make_spec(trials=6), tmp_path, in_memory=False) for _ in range(2))

    def dies_later(event: StudyEvent) -> None:
        if event.kind == "finished" and event.number == 2:
            other.study.ask().set_user_attr("worker", dead)

    reasons = [trial.user_attrs.get("reason") for trial in tuner.run(on_event=dies_later).study.get_trials()]
    assert (len(reasons), reasons.count(CRASHED_WORKER)) == (7, 1)


def test_two_workers_may_fail_the_same_trial_at_the_same_time(tmp_path: Path, dead: str) -> None:
    tuner, other = (SimulatedTuner(make_spec(trials=3), tmp_path, in_memory=False) for _ in range(2))
    lost = other.study.ask()
    lost.set_user_attr("worker", dead)
    get_trials = tuner.study.get_trials

    def then_the_other_is_quicker(*args: Any, **named: Any) -> list[FrozenTrial]:
        trials = get_trials(*args, **named)
        with suppress(ValueError):  # it has done so before
            other.study.tell(lost, state=TrialState.FAIL)
        return trials

    with patch.object(tuner.study, "get_trials", then_the_other_is_quicker):
        tuner.run()
    assert [trial.state for trial in tuner.study.get_trials()].count(TrialState.FAIL) == 1


def test_one_worker_makes_the_same_trials_again(tmp_path: Path) -> None:
    def drawn(name: str, seed: int) -> list[dict[str, object]]:
        tuner = SimulatedTuner(make_spec(sampler="tpe", sampler_seed=seed), tmp_path / name, effect=valley)
        tuner.study.enqueue_trial({"gain": 1.0, "wobble": 0})
        return [trial.params for trial in tuner.run().study.get_trials()]

    first = drawn("a", 1)
    assert first == drawn("b", 1) != drawn("c", 2)
    assert first[:2] == [{"gain": 1.5, "wobble": 2}, {"gain": 1.0, "wobble": 0}], "the default stays the first"
