"""Storage of a study: a journal file by default, any SQL database, or Optuna's gRPC proxy; and its trials.

From the top: the best trials and the Pareto front; the trials as a pandas frame; importances of the
settings; opening a storage; which workers of a study are alive; the journal file.
"""

import fcntl
import json
import math
import os
import socket
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pandas as pd
import psutil
from optuna.storages import BaseStorage, journal
from optuna.trial import FrozenTrial, TrialState, create_trial

from dynslam_bench.core import (
    StudyError,
    call_periodically,
    read_json,
    translate_errors,
    without_passwords,
)
from dynslam_bench.core.records import Record, validated
from dynslam_bench.tuning.database import open_database, without_password
from dynslam_bench.tuning.objectives import centre
from dynslam_bench.tuning.study_file import StudySpec

EARLIER = "earlier"
"""User attribute of trials that an earlier study made: which, and whether by other code. They are no candidates."""


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress warnings while the block lasts: Optuna warns of experimental parts, and of equal trials."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def is_feasible(trial: FrozenTrial) -> bool:
    """Whether a trial fulfils all constraints."""
    return all(value <= 0 for value in trial.constraints.values())


def best_trials(study: optuna.Study, count: int) -> list[FrozenTrial]:
    """The best complete trials that fulfil the constraints, without repeats of the same settings.

    Several objectives count together (geometric mean of their ratios). If no trial is feasible, the
    least bad ones. Where they are too few, pruned ones follow, those that came furthest first.
    """
    trials = [
        trial for trial in study.get_trials(deepcopy=False) if EARLIER not in trial.user_attrs
    ]

    # complete trials by their sum of log ratios
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    candidates = [trial for trial in complete if is_feasible(trial)] or complete
    candidates.sort(key=lambda trial: sum(trial.values))

    # pruned trials by the instances that they were run on, then by their ratio on these
    pruned = [
        trial
        for trial in trials
        if trial.state == TrialState.PRUNED and trial.user_attrs.get("scenes")
    ]
    pruned.sort(
        key=lambda trial: (
            -len(trial.user_attrs["instances"]),
            centre(trial.user_attrs["scenes"].values()),
        )
    )

    # of trials with the same settings the best one
    distinct: dict[tuple[Any, ...], FrozenTrial] = {}
    for trial in [*candidates, *pruned]:
        distinct.setdefault(tuple(sorted(trial.params.items())), trial)
    return list(distinct.values())[:count]


def front_trials(study: optuna.Study) -> list[FrozenTrial]:
    """The Pareto front of a study of several objectives: feasible trials of its own that no other one beats in all.

    Returns:
        The best in the first objective first, without repeats of the same values; empty for a study
        of one objective.
    """
    if len(study.directions) < 2:
        return []
    # the study's own feasible trials
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    candidates = [
        trial for trial in complete if EARLIER not in trial.user_attrs and is_feasible(trial)
    ]
    if not candidates:
        return []

    # Optuna finds the front of a study, here one in memory of these trials alone
    in_memory = optuna.create_study(directions=study.directions)
    with quiet():
        in_memory.add_trials(candidates)
    values_of_front = {tuple(trial.values) for trial in in_memory.best_trials}

    # back to the study's trials, of those with equal values the first
    front: dict[tuple[float, ...], FrozenTrial] = {}
    for trial in candidates:
        values = tuple(trial.values)
        if values in values_of_front:
            front.setdefault(values, trial)
    return [front[values] for values in sorted(front)]


def count_states(study: optuna.Study) -> dict[str, int]:
    """Number of trials that are complete, pruned, fail, running, waiting; states without a trial are left out."""
    return dict(Counter(trial.state.name.lower() for trial in study.get_trials(deepcopy=False)))


def extension_of(study: optuna.Study) -> dict[str, int]:
    """Scenes and trials by which a study was extended."""
    return {"scenes": 0, "trials": 0, **study.user_attrs.get("extension", {})}


# A study's trials as a pandas frame: one row a trial.


def trials_frame(spec: StudySpec, study: optuna.Study) -> pd.DataFrame:
    """All trials.

    Returns:
        One row a trial, in order; what is missing is ``pd.NA``.

        ``Int64`` columns:

        - trial: 0 is the baseline's settings;
        - runs: how many it was evaluated on.

        ``string`` columns:

        - state: ``complete``, ``pruned``, ``fail``, ``running``, ``waiting``;
        - reason: why it was pruned or failed; missing else;
        - earlier: the study that it was taken from, and whether its code was another; missing for
            the study's own trials.

        ``boolean`` column feasible: all constraints hold; missing for incomplete trials.

        ``Float64`` columns:

        - one for each objective, named after ``value_``, as Optuna has them: natural logarithms of
            ratios to the baseline, less is better;
        - ratio: the ATE ratio, below 1 is better than the baseline; missing if accuracy is no
            objective;
        - coverage: share, 0 to 1;
        - fps: frames a second;
        - duration_s: seconds from the start of the trial to its end.

        Then a column ``params.NAME`` for each tuned setting, in its own unit: ``Float64``,
        ``Int64``, ``boolean`` or ``string``, missing where its condition did not hold.
    """
    trials = study.get_trials(deepcopy=False)
    numbers = [f"value_{objective}" for objective in spec.objectives]
    numbers += ["ratio", "duration_s", "coverage", "fps"]
    kinds = {"trial": "Int64", "state": "string"}
    kinds |= dict.fromkeys(numbers, "Float64")
    kinds |= {"runs": "Int64", "feasible": "boolean", "reason": "string", EARLIER: "string"}
    rows = [_row(spec, trial) for trial in trials]
    frame = pd.DataFrame(rows, columns=list(kinds)).astype(kinds)

    # a column for each tuned setting
    settings: set[str] = set()
    for trial in trials:
        settings |= set(trial.params)
    for name in sorted(settings):
        frame[f"params.{name}"] = pd.array([trial.params.get(name) for trial in trials])
    return frame


def _row(spec: StudySpec, trial: FrozenTrial) -> dict[str, Any]:
    """One row of `trials_frame`, without the tuned settings; what is missing is None."""
    values = dict(zip(spec.objectives, trial.values or [], strict=False))
    # the objective "accuracy" is the log of the ratio of ATE to the baseline's
    accuracy = values.get("accuracy")
    return {
        **{f"value_{objective}": value for objective, value in values.items()},
        **{name: trial.user_attrs.get(name) for name in ("coverage", "fps", "reason", EARLIER)},
        "trial": trial.number,
        "state": trial.state.name.lower(),
        "ratio": None if accuracy is None else math.exp(accuracy),
        "duration_s": None if trial.duration is None else trial.duration.total_seconds(),
        "runs": len(trial.user_attrs.get("instances", ())),
        "feasible": is_feasible(trial) if trial.state == TrialState.COMPLETE else None,
    }


# Importances.

FEWEST_TRIALS = 20
"""With fewer complete or pruned trials importances are luck."""
_RESAMPLES = 50
"""Bootstrap samples of the trials, from which the intervals of importances are taken."""


class Importance(Record):
    """Importance of a parameter as a share of all, with its 95 % interval over resampled trials (bootstrap)."""

    share: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{100 * self.share:.0f} % [{100 * self.low:.0f}, {100 * self.high:.0f}]"


def scene_ratios(study: optuna.Study) -> dict[int, dict[str, float]]:
    """Log ratio by scene, of all objectives together, of each complete or pruned trial of the study itself."""
    trials = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED))
    return {
        trial.number: trial.user_attrs["scenes"] for trial in trials if "scenes" in trial.user_attrs
    }


def importances(study: optuna.Study) -> dict[str, Importance]:
    """Optuna's importances for all objectives together (PED-ANOVA, Watanabe et al. 2023), largest first.

    Returns:
        Shares that add up to 1; empty below `FEWEST_TRIALS` complete or pruned trials, or where
        their values are equal.
    """
    # copies of the trials with one objective, the mean log ratio over scenes and objectives
    trials = study.get_trials(deepcopy=False)
    copies = []
    for number, ratios in scene_ratios(study).items():
        trial = trials[number]
        copies.append(
            create_trial(
                params=trial.params,
                distributions=trial.distributions,
                value=centre(ratios.values()),
            )
        )
    if len(copies) < FEWEST_TRIALS or len({copy.value for copy in copies}) < 2:
        return {}

    # importances of all trials, and of bootstrap samples of them
    shares = _shares(copies)
    rng = np.random.default_rng(0)
    samples = rng.integers(len(copies), size=(_RESAMPLES, len(copies)))
    resampled = [_shares([copies[index] for index in sample]) for sample in samples]

    # a setting that a sample does not hold has no importance in it
    intervals = pd.DataFrame(resampled).fillna(0.0).quantile([0.025, 0.975])
    importance = {}
    for name, share in shares.items():
        low, high = intervals[name]
        importance[name] = Importance(share=share, low=float(low), high=float(high))
    return importance


def _shares(trials: Sequence[FrozenTrial]) -> dict[str, float]:
    """Optuna's importance of each parameter over these trials."""
    study = optuna.create_study()
    study.add_trials(trials)
    with quiet():
        evaluator = optuna.importance.PedAnovaImportanceEvaluator()
        return optuna.importance.get_param_importances(study, evaluator=evaluator)


SCHEMES = ("sqlite", "postgresql", "mysql", "mariadb", "oracle", "mssql", "grpc")
"""SQL databases (also with a driver: ``postgresql+psycopg``) and Optuna's gRPC proxy. They hold data, never code;
Optuna unpickles what Redis holds."""


def study_folder(results: Path, spec: StudySpec) -> Path:
    """The folder of a study's files: ``studies/NAME`` of the results folder."""
    return results / "studies" / spec.name


def open_storage(results: Path, spec: StudySpec) -> BaseStorage:
    """Open, or begin, the storage of a study.

    Raises:
        StudyError: It cannot be reached or written, or is of no kind that is known.
    """
    scheme, separator, address = spec.storage.partition("://")
    if spec.storage and not (separator and scheme.partition("+")[0] in SCHEMES):
        raise StudyError(
            f"the storage {without_passwords(spec.storage)!r} is of no kind that is known",
            f"one of {', '.join(SCHEMES)}",
        )
    folder = study_folder(results, spec)
    try:
        # a journal file in the study's folder, an SQL database, or Optuna's proxy
        if not spec.storage:
            folder.mkdir(parents=True, exist_ok=True)
            return optuna.storages.JournalStorage(JournalFile(folder / "journal.log"))
        if scheme != "grpc":
            return open_database(spec.storage)
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit():
            raise ValueError("write it as grpc://host:port")
        return optuna.storages.GrpcStorageProxy(host=host, port=int(port))
    except Exception as error:  # each driver raises errors of its own
        line = (str(error).strip() or type(error).__name__).splitlines()[0]
        text = without_password(
            f"cannot open the storage {spec.storage or folder}: {line}", spec.storage
        )
        raise StudyError(text, "check the address and the permissions") from None


SPEC_FILE = "study.json"
"""The file of a study's folder that holds its specification."""


def read_stored(folder: Path) -> tuple[StudySpec, Path]:
    """The study that lies in a folder, and the results folder that it lies in.

    Raises:
        StudyError: There is none.
    """
    stored = folder / SPEC_FILE
    if not stored.is_file():
        raise StudyError(
            f"{folder} holds no study: it has no {SPEC_FILE}", "name results/studies/NAME"
        )
    spec = validated(StudySpec, read_json(stored, kind=StudyError), str(stored), StudyError)
    # RESULTS/studies/NAME
    results = folder.absolute().parents[1]
    return spec, results


def load_study(results: Path, spec: StudySpec) -> optuna.Study:
    """Load a stored study.

    Args:
        results: The results folder.
        spec: The study.

    Raises:
        StudyError: There is none; nothing is made then.
    """
    absent = StudyError(
        f"there is no study '{spec.name}' in {results}", "dynslam-bench tune run STUDY.toml"
    )
    if not spec.storage and not study_folder(results, spec).is_dir():
        raise absent
    try:
        return optuna.load_study(study_name=spec.name, storage=open_storage(results, spec))
    except KeyError as error:
        raise absent from error


def worker_name() -> str:
    """The name of this process as a worker: host, boot, process namespace, process number, and when it started.

    The number alone is not enough: the system gives that of a process which has ended to another
    one.
    """
    return f"{_machine()}:{os.getpid()}.{started(os.getpid())}"


def started(pid: int) -> str:
    """Start time of a process as its system counts: clock ticks since the boot on Linux, which no clock changes.

    Raises:
        psutil.NoSuchProcess: There is none of this number.
    """
    if sys.platform != "linux":
        return str(int(psutil.Process(pid).create_time()))
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(errors="replace")
    except OSError as error:
        raise psutil.NoSuchProcess(pid) from error
    after_name = stat.rpartition(")")[2].split()  # the name may hold anything
    return after_name[_START_TIME]


_START_TIME = 19
"""Place of the time of start among the values of ``/proc/PID/stat`` that follow the name (proc(5), field 22)."""


@cache
def _machine() -> str:
    """Name of the place in which process numbers are unique: the host, and on Linux its boot and namespace."""
    names = [socket.gethostname()]
    with suppress(OSError):
        names.append(Path("/proc/sys/kernel/random/boot_id").read_text("ascii")[:8])
        names.append(Path("/proc/self/ns/pid").readlink().name.strip("pid:[]"))
    return "-".join(names)


HEARTBEAT_S = 20.0
"""A worker counts up once in so many seconds."""
GRACE_S = 120.0
"""A worker of another machine is dead once its count has stood still for so long."""
NAMELESS_S = 5.0
"""A running trial without a worker's name is abandoned after so long: it gets the name at once."""
_ALIVE = "alive "
"""Begins the study's attribute that holds a worker's count; its name follows."""


class Heartbeats:
    """Watches which workers of a study are alive.

    A worker of this machine is dead once its process is. A worker elsewhere is dead once its count
    in the study's attributes, which `beat` raises, has stood still for `GRACE_S` on this process'
    clock.

    Args:
        study: The study.
    """

    def __init__(self, study: optuna.Study) -> None:
        self._name = worker_name()
        self._study = study
        self._count = 0
        self._seen: dict[str, tuple[int | None, float]] = {}
        """The last count of each worker, and when it was first seen, seconds of the monotonic clock."""

    def is_dead(self, trial: FrozenTrial) -> bool:
        """Whether a running trial is abandoned: its worker has ended.

        A worker may end before it writes its name to the trial. Such a trial is abandoned once it
        has been nameless for `NAMELESS_S` and all other workers have ended.
        """
        if worker := trial.user_attrs.get("worker"):
            return self._has_ended(worker)
        workers = {
            key.removeprefix(_ALIVE) for key in self._study.user_attrs if key.startswith(_ALIVE)
        }
        # look at every worker, which starts the clocks of all
        have_ended = [self._has_ended(name) for name in workers - {self._name}]
        is_nameless = self._seconds_unchanged(f"trial {trial.number}", None) > NAMELESS_S
        return is_nameless and all(have_ended)

    def _has_ended(self, name: str) -> bool:
        """Whether a worker, by the name that `worker_name` gave it, is dead."""
        # a worker of this machine: look at its process, which must have started when the name says
        machine, _, process = name.rpartition(":")
        pid, _, start = process.partition(".")
        if machine == _machine() and pid.isdigit():
            try:
                if psutil.Process(int(pid)).status() == psutil.STATUS_ZOMBIE:
                    return True
                if start:
                    return started(int(pid)) != start
            except psutil.NoSuchProcess:
                return True
        # on another machine, or of an earlier version, which did not say when it started
        return self._seconds_unchanged(name, self._study.user_attrs.get(_ALIVE + name)) > GRACE_S

    def _seconds_unchanged(self, name: str, count: int | None) -> float:
        """Seconds since a worker's count was first seen at its present value; 0 at the first look."""
        now = time.monotonic()
        if name not in self._seen or self._seen[name][0] != count:
            self._seen[name] = count, now
        return now - self._seen[name][1]

    def running(self) -> dict[int, str]:
        """The running trials, each with its worker and whether that is alive.

        A worker elsewhere is silent if it does not count up while this waits, a little longer than
        `HEARTBEAT_S`.
        """
        # the workers elsewhere, until one after the other counts up
        trials = self._study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
        workers = {trial.number: trial.user_attrs.get("worker", "") for trial in trials}
        counts = self._study.user_attrs
        deadline = time.monotonic() + 1.25 * HEARTBEAT_S
        silent = {name for name in workers.values() if name.rpartition(":")[0] != _machine()}
        while silent and time.monotonic() < deadline:
            time.sleep(0.2)
            now = self._study.user_attrs
            silent = {
                name for name in silent if now.get(_ALIVE + name) == counts.get(_ALIVE + name)
            }

        # the state of each trial's worker
        states = {}
        for number, name in workers.items():
            if name in silent:
                state = "silent"
            else:
                state = "dead" if self._has_ended(name) else "alive"
            states[number] = f"{name}, {state}"
        return states

    def beat(self) -> None:
        """Count up once."""
        self._count += 1
        self._study.set_user_attr(_ALIVE + self._name, self._count)

    def beating(self) -> AbstractContextManager[None]:
        """Count up while the block lasts."""

        def beat() -> None:
            with suppress(Exception):  # the trials themselves say what is wrong with the storage
                self.beat()

        return call_periodically(HEARTBEAT_S, beat)


class JournalFile(journal.JournalFileBackend):
    """Optuna's journal file, to which whole lines are appended or nothing.

    A line that a killed process left unfinished is cut off before the next one is written: Optuna
    appends to it, and can never read the file again. What did not fit on the disk is taken back.
    The lock is on the file itself and ends with its process; Optuna's own outlives a killed process
    by 30 s.

    Args:
        path: The file; begun if it is missing.

    Raises:
        StudyError: It cannot be begun.
    """

    def __init__(self, path: Path) -> None:
        if path.is_symlink():
            raise StudyError(
                f"{path} is a link: a study is written in its own folder",
                "put the file in its place",
            )
        with _writing(path):
            super().__init__(str(path))
        self.path = path

    def append_logs(self, logs: Sequence[dict[str, Any]]) -> None:
        """Append entries.

        Raises:
            StudyError: They cannot be written; then the file is as it was.
        """
        lines = "".join(json.dumps(log, separators=(",", ":")) + "\n" for log in logs)
        rest = memoryview(lines.encode())
        with _writing(self.path), self.path.open("r+b", buffering=0) as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            # what a killed process left unfinished is cut off
            end = file.readall().rfind(b"\n") + 1
            file.truncate(end)
            file.seek(end)
            try:
                while rest:
                    rest = rest[file.write(rest) :]
                os.fsync(file.fileno())
            except OSError:
                file.truncate(end)
                raise


def _writing(path: Path) -> AbstractContextManager[None]:
    """Turns errors of the disk into one line that names the file."""
    return translate_errors(
        StudyError, f"cannot write {path}", "free some space, or check the folder; then go on"
    )
