"""The gate: from measurements to a verdict, the files that it reads, and revisions that are built and run in turns."""

import json
import math
import os
import re
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest
from helpers.envs_toys import TARGET, write_folder
from helpers.gate_repository import (
    BUILD,
    TRACKER,
    commit,
    git,
    make_repository,
    write_version,
)

from dynslam_bench import gate as gates
from dynslam_bench.core import RunError
from dynslam_bench.evaluation.gate import GateVerdict
from dynslam_bench.gate.baseline import Measurement, Origin, Side, poses_digest
from dynslam_bench.gate.config import GateConfig, Guardrails
from dynslam_bench.gate.judging import judge
from dynslam_bench.gate.revisions import build, commit_of, untracked_files, working_tree
from dynslam_bench.gate.trajectory_folder import file_name
from dynslam_bench.gate.worker import make
from dynslam_bench.geometry import Trajectory, read_tum, write_tum
from dynslam_bench.runs.process.fork_server import START_VARIABLE

SCHEMA = Path(gates.__file__).with_name("gate.schema.json")
CASES = [f"sequence {number}" for number in range(24)]
CONFIG = GateConfig(trackers=("a",), sequences=("b",))


def side_of(name, errors, **facts):
    """A side whose errors are ``[S, K]``; nan is a lost run."""
    runs = []
    for case, of_case in zip(CASES, np.asarray(errors, float), strict=False):
        for number, error in enumerate(of_case.tolist()):
            lost = math.isnan(error)
            runs.append(
                Measurement(
                    case=case,
                    round=number,
                    status="lost" if lost else "ok",
                    reason="it lost track" if lost else "",
                    ate_m=None if lost else error,
                    coverage=0.2 if lost else 1.0,
                    trajectories={"online": repr((case, number, error))},
                    **facts,
                )
            )
    return Side(name, runs)


def noisy(sequences=8, rounds=10, scale=1.0, seed=0, spread=0.1):
    """Errors of one centimetre that scatter from run to run."""
    rng = np.random.default_rng(seed)
    return 0.01 * scale * np.exp(spread * rng.normal(size=(sequences, rounds)))


def judged(baseline, candidate, rounds, config=CONFIG, **how):
    return judge(side_of("a", baseline), side_of("b", candidate), config, rounds, **how)


# -- what is found in measurements -------------------------------------------------------------------


def test_equal_bits_are_identical_after_one_round() -> None:
    errors = noisy()
    found = judged(errors, errors, 1)
    assert found.verdict is GateVerdict.IDENTICAL
    assert found.exit_code == 0
    assert all(case.identical for case in found.cases)


def test_one_round_that_differs_tells_nothing() -> None:
    found = judged(noisy(), 3.0 * noisy(), 1)
    assert found.verdict is GateVerdict.UNDECIDED
    assert found.exit_code == 5


@pytest.mark.parametrize(
    ("scale", "verdict", "code"),
    [(1.3, GateVerdict.REGRESSED, 4), (0.7, GateVerdict.IMPROVED, 0)],
)
def test_a_change_of_thirty_percent_is_found(scale, verdict, code) -> None:
    found = judged(noisy(), noisy(scale=scale, seed=1), 4)
    assert found.verdict is verdict
    assert found.exit_code == code
    assert math.exp(found.estimate.centre) == pytest.approx(scale, rel=0.1)


def test_no_difference_needs_both_ends_within_the_margin() -> None:
    found = judged(noisy(spread=0.02), noisy(spread=0.02, seed=1), 3)
    assert found.verdict is GateVerdict.NO_DIFFERENCE
    narrow = CONFIG.model_copy(update={"margin": 0.001})
    found = judged(noisy(spread=0.02), noisy(spread=0.02, seed=1), 3, narrow)
    assert found.verdict is GateVerdict.UNDECIDED


@pytest.mark.parametrize("others", [0.95, 0.5])
def test_one_sequence_that_is_lost_is_never_an_improvement(others) -> None:
    baseline = noisy(spread=0.01)
    candidate = others * noisy(spread=0.01, seed=1)
    candidate[0] = math.nan
    for rounds in (2, 3, 4, 6, 8, 10):
        found = judged(baseline, candidate, rounds)
        assert found.verdict in (GateVerdict.UNDECIDED, GateVerdict.REGRESSED)
        assert found.exit_code in (3, 4)


def test_one_more_lost_run_is_never_an_improvement() -> None:
    baseline = noisy()
    candidate = noisy(scale=0.7, seed=1)
    candidate[0, 0] = math.nan
    found = judged(baseline, candidate, 4)
    assert found.verdict is GateVerdict.UNDECIDED
    assert found.exit_code == 3
    assert found.lost == (1, 0)
    assert found.guardrails[0].measured == 0.0, "the coverage is that of runs that were not lost"


@pytest.mark.parametrize("who", ["candidate", "baseline", "both"])
def test_when_all_runs_are_lost_nothing_passes(who) -> None:
    lost = np.full((8, 4), math.nan)
    baseline = noisy(rounds=4) if who == "candidate" else lost
    candidate = noisy(rounds=4) if who == "baseline" else lost
    found = judged(baseline, candidate, 4)
    assert found.exit_code in (3, 4)
    assert found.verdict not in (
        GateVerdict.IDENTICAL,
        GateVerdict.IMPROVED,
        GateVerdict.NO_DIFFERENCE,
    )


def test_sequences_that_both_lose_shrink_no_interval() -> None:
    baseline = noisy(4, 4)
    candidate = noisy(4, 4, seed=1)
    without = judged(baseline, candidate, 4).estimate
    lost = np.full((4, 4), math.nan)
    with_lost = judged(np.vstack([baseline, lost]), np.vstack([candidate, lost]), 4).estimate
    assert with_lost == without


@pytest.mark.parametrize("rounds", [2, 3, 4, 6, 8, 10])
@pytest.mark.parametrize("seed", [0, 10, 20])
def test_exchanging_the_sides_turns_the_verdict_around(seed, rounds) -> None:
    baseline = noisy(seed=seed)
    candidate = noisy(seed=seed + 1, scale=1.1)
    forward = judged(baseline, candidate, rounds)
    backward = judged(candidate, baseline, rounds)
    turned = {
        GateVerdict.REGRESSED: GateVerdict.IMPROVED,
        GateVerdict.IMPROVED: GateVerdict.REGRESSED,
    }
    assert backward.verdict is turned.get(forward.verdict, forward.verdict)
    assert backward.estimate.centre == pytest.approx(-forward.estimate.centre)


# -- guardrails ----------------------------------------------------------------------------------------


def guarded(**limits):
    return CONFIG.model_copy(update={"guardrails": Guardrails(**limits)})


def test_a_fall_of_coverage_breaks_a_gate_whose_errors_are_smaller() -> None:
    baseline = side_of("a", noisy())
    candidate = side_of("b", noisy(scale=0.5, seed=1))
    for run in candidate.all(10):
        run.coverage = 0.9
    found = judge(baseline, candidate, CONFIG, 4)
    assert found.verdict is GateVerdict.IMPROVED
    assert found.overall is GateVerdict.REGRESSED
    assert found.exit_code == 4
    assert [rail.state for rail in found.guardrails] == ["broken"]
    assert found.guardrails[0].measured == pytest.approx(0.1)


@pytest.mark.parametrize("rounds", [2, 4, 8])
def test_one_sequence_of_many_that_is_hardly_tracked_is_no_improvement(rounds) -> None:
    baseline = side_of("a", noisy(24, spread=0.01))
    candidate = side_of("b", noisy(24, scale=0.95, spread=0.01, seed=1))
    for run in candidate.by_case["sequence 0"]:
        run.coverage = 0.6
    found = judge(baseline, candidate, CONFIG, rounds)
    assert found.verdict is GateVerdict.IMPROVED
    assert found.guardrails[0].measured < CONFIG.guardrails.coverage
    assert "sequence 0" in found.guardrails[0].text

    # a few rounds may be chance, eight are not
    assert found.exit_code == (4 if rounds == 8 else 5)
    expected = GateVerdict.REGRESSED if rounds == 8 else GateVerdict.UNDECIDED
    assert found.overall is expected
    assert found.is_settled is (rounds == 8)


@pytest.mark.parametrize("limits", [{"frame_time": 1.2}, {"memory": 1.2}])
def test_a_limit_on_what_no_run_tells_is_no_pass(limits) -> None:
    errors = noisy()
    found = judged(errors, errors, 1, guarded(**limits))
    assert found.verdict is GateVerdict.IDENTICAL
    assert found.overall is GateVerdict.UNDECIDED
    assert found.exit_code == 5


@pytest.mark.parametrize(
    ("times", "spread", "state"), [(1.5, 0.02, "broken"), (1.0, 0.02, "held"), (1.15, 0.3, "open")]
)
def test_frame_times_are_paired(times, spread, state) -> None:
    rng = np.random.default_rng(3)
    baseline = side_of("a", noisy(spread=0.02))
    candidate = side_of("b", noisy(spread=0.02, seed=1))
    for before, after in zip(baseline.all(10), candidate.all(10), strict=True):
        before.frame_time_s = 0.02 * math.exp(spread * rng.normal())
        after.frame_time_s = 0.02 * times * math.exp(spread * rng.normal())
    found = judge(baseline, candidate, guarded(frame_time=1.2), 4)
    assert found.guardrails[-1].state == state
    assert found.exit_code == {"broken": 4, "held": 0, "open": 5}[state]
    assert [rail.state for rail in found.overruling] == [state] * (state != "held")
    untimed = judge(baseline, candidate, guarded(frame_time=1.2), 4, timed=False)
    assert untimed.guardrails[-1].state == "not measured"
    # what the exit code leaves out does not overrule the verdict, either
    single = judge(baseline, candidate, guarded(frame_time=1.2), 1, timed=False)
    assert single.exit_code == 5
    assert not single.overruling


def test_a_floor_names_the_sequence() -> None:
    candidate = noisy(spread=0.01, seed=1)
    candidate[3] *= 1.6
    found = judged(noisy(spread=0.01), candidate, 2, guarded(sequence=1.5))
    assert found.guardrails[-1].state == "broken"
    assert "sequence 3" in found.guardrails[-1].text


def test_lost_runs_may_be_limited_by_number() -> None:
    baseline = noisy(spread=0.01)
    candidate = noisy(spread=0.01, seed=1)
    candidate[0, 0] = math.nan
    assert judged(baseline, candidate, 10, guarded(failures=0)).exit_code == 4
    assert judged(baseline, candidate, 10, guarded(failures=1)).exit_code == 3


# -- the question --------------------------------------------------------------------------------------


def write_gate(folder, sequences, **values):
    """A question in a folder."""
    lines = {"trackers": [TRACKER], "sequences": [str(path) for path in sequences], "build": BUILD}
    lines |= values
    tables = {name: value for name, value in lines.items() if isinstance(value, dict)}
    text = "".join(
        f"{name} = {json.dumps(value)}\n" for name, value in lines.items() if name not in tables
    )
    for name, table in tables.items():
        text += f"[{name}]\n" + "".join(
            f"{key} = {json.dumps(value)}\n" for key, value in table.items()
        )
    (folder / "gate.toml").write_text(text)
    return folder / "gate.toml"


@pytest.mark.parametrize(
    "values",
    [
        {"marginn": 0.1},
        {"rounds": 5},
        {"protocol": "none"},
        {"sequences": []},
        {"suite": "smoke"},
        {"margin": 0},
        {"guardrails": {"frame_time": 0.9}},
        {"seed": 2**70},
        {"build_minutes": 0},
    ],
)
def test_a_wrong_question_is_refused(tmp_path, values) -> None:
    with pytest.raises(Exception) as caught:
        gates.load_gate(write_gate(tmp_path, ["synthetic/walking_xyz"], **values))
    assert "\n" not in str(caught.value)


def test_no_question_says_how_to_write_one(tmp_path) -> None:
    with pytest.raises(RunError) as caught:
        gates.check(tmp_path / "gate.toml")
    assert "gate init" in caught.value.hint


def test_a_question_is_written_and_read_again(tmp_path) -> None:
    file = gates.init(tmp_path / "gate.toml", trackers=['subprocess:./a "b"'], build='c "d" \\')
    gate = gates.load_gate(file)
    assert gate.config.trackers == ('subprocess:./a "b"',)
    assert gate.config.build == 'c "d" \\'
    assert len(gate.cases()) == 8
    with pytest.raises(RunError):
        gates.init(file)


def test_a_suite_and_single_cases_are_run_too(tmp_path) -> None:
    (tmp_path / "gate.toml").write_text(
        'suite = "smoke"\n[[cases]]\ntracker = "never-move"\nsequence = "synthetic/walking_rpy"\nframes = [0, 9]\n'
    )
    cases = gates.load_gate(tmp_path / "gate.toml").cases()
    assert len(cases) == 9
    assert {spec.seed for spec in cases.values()} == {0}


def test_equal_cases_are_refused(tmp_path) -> None:
    file = write_gate(tmp_path, ["synthetic/walking_xyz", "synthetic/walking_xyz"])
    with pytest.raises(RunError):
        gates.load_gate(file).cases()


def test_sequences_that_are_too_short_for_all_rounds_are_refused_first(tmp_path, sequences) -> None:
    question = write_gate(tmp_path, sequences, frames=[0, 7], rounds=8)
    with pytest.raises(RunError) as caught:
        gates.compare("HEAD", "", question)
    assert "7 frames are too few" in str(caught.value)
    assert "9 are needed" in str(caught.value)


def test_a_run_that_the_package_of_a_checkout_refuses_is_one_line() -> None:
    answer = make({"spec": {"tracker": "a", "sequence": "b", "seed": -1}, "results": "nowhere"})
    assert "seed" in answer["error"]
    assert "\n" not in answer["error"]


def test_the_digest_of_poses_ignores_comments(tmp_path) -> None:
    (tmp_path / "a.txt").write_text("# of A\n1.0 0 0 0 0 0 0 1\n")
    (tmp_path / "b.txt").write_text("# of B\n1.0 0 0 0 0 0 0 1\n")
    assert poses_digest(tmp_path / "a.txt") == poses_digest(tmp_path / "b.txt") != ""


# -- a repository that is built and run ------------------------------------------------------------------


NOISY_M = 0.1
"""Ten times the noise of the first version: after two rounds the question is decided."""


@pytest.fixture(autouse=True)
def fresh_children(monkeypatch):
    """Each side makes a few runs: a fork server would take longer to start than they do."""
    monkeypatch.setenv(START_VARIABLE, "fresh")


@pytest.fixture(scope="module")
def sequences(tmp_path_factory):
    """Two recordings of the toy world, as short as the starts of ten rounds allow."""
    root = tmp_path_factory.mktemp("sequences")
    return [write_folder(root / "one", 11), write_folder(root / "two", 12)]


@pytest.fixture
def repository(tmp_path, sequences):
    """A repository with one commit and a question about one sequence."""
    folder = make_repository(tmp_path / "repository")
    write_gate(folder, sequences[:1])
    commit(folder, "ask")
    return folder


@pytest.mark.slow
def test_from_nothing_to_a_verdict_by_one_command(tmp_path, sequences) -> None:
    folder = make_repository(tmp_path / "repository")
    write_version(folder, NOISY_M)
    commit(folder, "more noise")
    script = Path(__file__).parents[2] / "packaging" / "gate-action" / "gate.sh"
    package = str(Path(__file__).parents[2])
    variables = {
        "PYTHON": sys.executable,
        "PYTHONPATH": package,
        "TRACKER": TRACKER,
        "BUILD": BUILD,
        "SEQUENCES": "\n".join(map(str, sequences)),
        "SUMMARY": str(tmp_path / "summary.md"),
    }
    ended = subprocess.run(
        ["bash", str(script), "HEAD~1", "HEAD"],
        cwd=folder,
        env=os.environ | variables,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 4, ended.stderr
    summary = (tmp_path / "summary.md").read_text()
    assert summary.startswith("**regressed**")
    assert len(summary.splitlines()) <= 10
    assert not git(folder, "worktree", "list").count("\n"), "the checkouts are removed"


@pytest.mark.slow
def test_record_check_and_compare(repository) -> None:
    question = repository / "gate.toml"
    results = repository / "results"
    made = gates.record(question, results=results)
    assert {run.status for run in made.runs} == {"ok"}
    commit(repository, "baseline")

    # nothing changed: equal to the last bit, after one round
    same = gates.check(question, results=results)
    assert same.verdict is GateVerdict.IDENTICAL
    assert same.rounds == 1
    assert not same.reran_baseline

    # more noise, not committed: the baseline is built and run again, in turns
    write_version(repository, NOISY_M)
    worse = gates.check(question, results=results)
    assert worse.verdict is GateVerdict.REGRESSED
    assert worse.exit_code == 4
    assert worse.reran_baseline
    assert worse.candidate.uncommitted == [git(repository, "diff", "--name-only")]
    assert Path(worse.page).is_file()
    assert worse.sentence in (Path(worse.page).parent / "data" / "ratios.js").read_text()

    # by the recorded runs alone
    by_files = gates.check(question, files_only=True, results=results)
    assert by_files.verdict is GateVerdict.REGRESSED
    assert not by_files.reran_baseline

    # the other way around, of two revisions
    second = commit(repository, "more noise")
    better = gates.compare(second, "HEAD~1", question, results=results)
    assert better.verdict is GateVerdict.IMPROVED
    assert better.ratio == pytest.approx(1.0 / worse.ratio)


@pytest.mark.slow
def test_a_loss_beside_small_gains_is_no_improvement(repository, sequences) -> None:
    write_gate(repository, sequences, rounds=2)
    write_version(repository, 0.0095, lost_in=sequences[0].name)
    commit(repository, "5 % better, but lost on one")
    result = gates.compare(
        "HEAD~1", "HEAD", repository / "gate.toml", results=repository / "results"
    )
    assert result.verdict not in (
        GateVerdict.IMPROVED,
        GateVerdict.NO_DIFFERENCE,
        GateVerdict.IDENTICAL,
    )
    assert not result.passed


@pytest.mark.slow
def test_a_confirmation_set_is_counted(repository, sequences) -> None:
    write_gate(repository, sequences[:1], confirm=[str(sequences[1])])
    commit(repository, "confirm")
    question = repository / "gate.toml"
    gates.record(question, results=repository / "results", rounds=1)
    assert gates.check(question, results=repository / "results").look == 0
    first = gates.check(question, confirm=True, results=repository / "results")
    second = gates.check(question, confirm=True, results=repository / "results")
    assert [first.look, second.look] == [1, 2]
    assert [case.case for case in second.cases] == ["two"]


@pytest.mark.slow
def test_a_plug_in_is_judged(tmp_path, sequences) -> None:
    file = write_gate(
        tmp_path, sequences[:1], trackers=[TARGET], build="", settings={"noise.level_m": 1e-3}
    )
    gates.record(file, results=tmp_path / "results")
    result = gates.check(file, results=tmp_path / "results")
    assert result.verdict is GateVerdict.IDENTICAL


@pytest.mark.slow
class TestBadInput:
    """Each fault is one line with its cure, and never a pass."""

    def test_no_baseline(self, repository) -> None:
        with pytest.raises(RunError) as caught:
            gates.check(repository / "gate.toml")
        assert "gate record" in caught.value.hint

    def test_uncommitted_changes(self, repository) -> None:
        write_version(repository, 0.03)
        with pytest.raises(RunError) as caught:
            gates.record(repository / "gate.toml")
        assert git(repository, "diff", "--name-only") in str(caught.value)
        assert "--uncommitted" in caught.value.hint

    def test_a_revision_that_does_not_exist(self, repository) -> None:
        with pytest.raises(RunError) as caught:
            gates.compare("nowhere", "", repository / "gate.toml")
        assert "'nowhere'" in str(caught.value)

    def test_no_repository(self, tmp_path, sequences) -> None:
        with pytest.raises(RunError) as caught:
            gates.compare("HEAD", "", write_gate(tmp_path, sequences))
        assert "git init" in caught.value.hint

    def test_a_build_that_fails(self, repository) -> None:
        command = "echo the compiler says no; exit 7"
        with pytest.raises(RunError) as caught:
            gates.compare("HEAD", "HEAD", repository / "gate.toml", build_command=command)
        assert "code 7: the compiler says no" in str(caught.value)
        assert not git(repository, "worktree", "list").count("\n")

    @pytest.mark.parametrize("name", ["^HEAD", "HEAD..HEAD", "my branch", "-x", "--all", ""])
    def test_a_text_that_names_no_commit(self, repository, name) -> None:
        with pytest.raises(RunError) as caught:
            commit_of(repository, name)
        assert f"'{name}'" in str(caught.value)

    def test_a_repository_that_git_does_not_read(self, repository, monkeypatch) -> None:
        monkeypatch.setenv("GIT_TEST_ASSUME_DIFFERENT_OWNER", "1")
        with pytest.raises(RunError) as caught:
            commit_of(repository, "HEAD")
        assert "ownership" in str(caught.value)
        assert "safe.directory" in caught.value.hint

    def test_a_build_that_hangs_ends_with_all_that_it_started(self, tmp_path) -> None:
        # the end of the pipe is read when the last process that holds it is gone
        os.mkfifo(tmp_path / "pipe")
        reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
        command = "exec 3>pipe; sleep 600 & echo compiling; wait"
        with pytest.raises(RunError) as caught:
            build(command, tmp_path, "revision a", minutes=1 / 60)
        assert "did not end" in str(caught.value)
        assert "compiling" in str(caught.value)
        os.set_blocking(reader, True)
        assert os.read(reader, 1) == b""
        os.close(reader)

    def test_a_build_that_asks_gets_no_answer(self, tmp_path) -> None:
        with pytest.raises(RunError) as caught:
            build("read answer || exit 9", tmp_path, "revision a", minutes=1)
        assert "exit code 9" in str(caught.value)

    def test_files_that_no_revision_holds(self, repository) -> None:
        (repository / "parameters ä.yaml").write_text("a: 1\n")
        (repository / "build").mkdir(exist_ok=True)
        (repository / "build" / "ignored").touch()
        assert untracked_files(repository) == ["parameters ä.yaml"]
        assert untracked_files(repository, (repository / "parameters ä.yaml",)) == []
        git(repository, "add", "-A")
        assert working_tree(repository).uncommitted == ["parameters ä.yaml"]

    def test_missing_sequences(self, repository, sequences) -> None:
        question = write_gate(repository, [*sequences, "tum/fr3/walking_xyz", "nowhere/at_all"])
        with pytest.raises(RunError) as caught:
            gates.compare("HEAD", "HEAD", question, data_root=repository)
        assert "2 of 4 sequences" in str(caught.value)

    def test_another_protocol_machine_and_question(self, repository, sequences) -> None:
        question = repository / "gate.toml"
        gates.record(question, results=repository / "results", rounds=1)
        file = repository / "gate-baseline.json"
        text = json.loads(file.read_text())

        # another machine: said, and errors are compared
        text["machine"]["cpu"] = "Another CPU"
        file.write_text(json.dumps(text))
        write_gate(repository, sequences[:1], margin=0.2)
        result = gates.check(question, results=repository / "results")
        assert result.verdict is GateVerdict.IDENTICAL
        assert any("Another CPU" in note for note in result.notes)
        assert result.changed_question == ["margin was 0.1, is 0.2"]

        # sequences that the baseline lacks
        write_gate(repository, sequences)
        with pytest.raises(RunError) as caught:
            gates.check(question)
        assert "lacks 1 of 2" in str(caught.value)

        # another protocol
        write_gate(repository, sequences[:1], protocol="evo-default")
        with pytest.raises(RunError) as caught:
            gates.check(question)
        assert "evo-default" in str(caught.value)

    def test_a_damaged_baseline(self, repository) -> None:
        (repository / "gate-baseline.json").write_text("{}")
        with pytest.raises(RunError) as caught:
            gates.check(repository / "gate.toml")
        assert "\n" not in str(caught.value)

    def test_all_runs_lost(self, repository, sequences) -> None:
        write_gate(repository, sequences[:1], rounds=2)
        write_version(repository, 0.01, lost_in="op")
        commit(repository, "loses everything")
        with pytest.raises(RunError) as caught:
            gates.record(repository / "gate.toml", results=repository / "results")
        assert "all 2 runs were lost" in str(caught.value)
        result = gates.compare(
            "HEAD~1", "HEAD", repository / "gate.toml", results=repository / "results"
        )
        assert result.exit_code in (3, 4)
        assert "all runs of the candidate" in result.sentence


# -- trajectories of others --------------------------------------------------------------------------------


def write_trajectories(folder, sequences, noise_m, runs=1, seed=0):
    """Trajectory files as a gate reads them: the truth with noise."""
    rng = np.random.default_rng(seed)
    for sequence in sequences:
        truth = read_tum(sequence / "groundtruth.txt")
        for number in range(runs):
            poses = truth.T_world_cam.copy()
            poses[:, :3, 3] += noise_m * rng.normal(size=(len(poses), 3))
            several = folder / file_name(sequence.name)
            target = (
                several / f"{number}.txt"
                if runs > 1
                else folder / f"{file_name(sequence.name)}.txt"
            )
            target.parent.mkdir(parents=True, exist_ok=True)
            write_tum(target, Trajectory(truth.timestamps, poses))
    return folder


def test_trajectories_of_others_are_judged(tmp_path, sequences) -> None:
    question = write_gate(tmp_path, sequences, build="")
    results = tmp_path / "results"
    one = write_trajectories(tmp_path / "one", sequences, 0.01)
    gates.record(question, trajectories=one, results=results)

    # the same files; then others, of which one a sequence tells nothing
    assert gates.check(question, trajectories=one, results=results).verdict is GateVerdict.IDENTICAL
    other = write_trajectories(tmp_path / "other", sequences, 0.05, seed=1)
    single = gates.check(question, trajectories=other, results=results)
    assert single.verdict is GateVerdict.UNDECIDED
    assert single.exit_code == 5

    # several runs of both sides
    before = write_trajectories(tmp_path / "before", sequences, 0.01, runs=3, seed=2)
    after = write_trajectories(tmp_path / "after", sequences, 0.05, runs=3, seed=3)
    gates.record(question, trajectories=before, results=results)
    assert (
        gates.check(question, trajectories=after, results=results).verdict is GateVerdict.REGRESSED
    )


def test_copies_of_one_run_show_no_scatter(tmp_path, sequences) -> None:
    question = write_gate(tmp_path, sequences, build="")
    results = tmp_path / "results"
    folders = []
    for seed, noise_m in ((1, 0.01), (2, 0.05)):
        folder = write_trajectories(tmp_path / str(seed), sequences, noise_m, runs=3, seed=seed)
        for sequence in sequences:
            first = folder / file_name(sequence.name) / "0.txt"
            for number in (1, 2):
                first.with_name(f"{number}.txt").write_text(first.read_text())
        folders.append(folder)
    gates.record(question, trajectories=folders[0], results=results)
    result = gates.check(question, trajectories=folders[1], results=results)
    assert result.verdict is GateVerdict.UNDECIDED
    assert result.exit_code == 5
    assert any("equal to the last bit on one, two" in note for note in result.notes)


@pytest.mark.parametrize("first_is_equal", [False, True])
def test_copies_on_one_sequence_of_two_count_as_one_run(
    tmp_path, sequences, first_is_equal
) -> None:
    question = write_gate(tmp_path, sequences, build="")
    results = tmp_path / "results"
    before = write_trajectories(tmp_path / "before", sequences, 0.01, runs=3, seed=1)
    after = write_trajectories(tmp_path / "after", sequences, 0.05, runs=3, seed=2)
    copied = after / file_name(sequences[0].name)
    for number in (1, 2):
        (copied / f"{number}.txt").write_text((copied / "0.txt").read_text())
    if first_is_equal:
        for sequence in sequences:
            own = file_name(sequence.name)
            (before / own / "0.txt").write_text((after / own / "0.txt").read_text())
    gates.record(question, trajectories=before, results=results)
    result = gates.check(question, trajectories=after, results=results)
    assert result.verdict is GateVerdict.UNDECIDED
    assert result.rounds == 1
    assert result.low is None
    assert any("candidate are equal to the last bit on one:" in note for note in result.notes)


def test_errors_on_other_data_are_not_compared(tmp_path) -> None:
    sequence = write_folder(tmp_path / "one", 14)
    question = write_gate(tmp_path, [sequence], build="")
    files = write_trajectories(tmp_path / "files", [sequence], 0.01)
    gates.record(question, trajectories=files, results=tmp_path / "results")
    truth = read_tum(sequence / "groundtruth.txt")
    truth.T_world_cam[:, 0, 3] *= 1.1
    write_tum(sequence / "groundtruth.txt", truth)
    with pytest.raises(RunError) as caught:
        gates.check(question, trajectories=files, results=tmp_path / "results")
    assert "other data of one" in str(caught.value)


def test_the_files_of_a_sequence_are_told_apart(tmp_path, sequences) -> None:
    question = write_gate(tmp_path, sequences, build="")
    files = write_trajectories(tmp_path / "files", sequences, 0.01)
    (files / ".one.txt").write_text("hidden")
    gates.record(question, trajectories=files, results=tmp_path / "results")

    # a second file could be meant
    (files / "one.bak").write_text((files / "one.txt").read_text())
    with pytest.raises(RunError) as caught:
        gates.check(question, trajectories=files)
    assert "one.bak, one.txt" in str(caught.value)


def test_two_sequences_whose_files_have_one_name_are_refused(tmp_path) -> None:
    names = ["a b", "a_b"]
    folders = [write_folder(tmp_path / name, 14) for name in names]
    question = write_gate(tmp_path, folders, build="")
    with pytest.raises(RunError) as caught:
        gates.record(question, trajectories=tmp_path)
    assert "same name, a_b" in str(caught.value)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda text: text[: len(text) // 2], "Invalid JSON"),
        (lambda text: text.replace('"schema_version": 1', '"schema_version": 2, "x": 1'), "schema"),
        (lambda text: text.replace('"round": 0', '"round": 1', 1), "round 1 where 0"),
        (lambda text: re.sub(r'"ate_m": [0-9.e-]+', '"ate_m": "Infinity"', text), "finite"),
        (lambda text: re.sub(r'"ate_m": [0-9.e-]+', '"ate_m": "NaN"', text), "ate_m"),
        (lambda text: text.replace('"margin"', '"margins"'), "margins"),
    ],
)
def test_a_damaged_baseline_is_refused_in_one_line(tmp_path, sequences, damage, words) -> None:
    question = write_gate(tmp_path, sequences, build="")
    files = write_trajectories(tmp_path / "files", sequences, 0.01)
    gates.record(question, trajectories=files, results=tmp_path / "results")
    baseline = tmp_path / "gate-baseline.json"
    before = baseline.read_text()
    baseline.write_text(damage(before))
    assert baseline.read_text() != before
    with pytest.raises(RunError) as caught:
        gates.check(question, trajectories=files, results=tmp_path / "results")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.hint

    # the cure works
    made = gates.record(question, trajectories=files, results=tmp_path / "results")
    assert words in made.notes[0]
    again = gates.check(question, trajectories=files, results=tmp_path / "results")
    assert again.verdict is GateVerdict.IDENTICAL


def test_the_json_fits_its_schema_and_nothing_else_does(tmp_path, sequences) -> None:
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema (extra [test]) is missing")
    schema = json.loads(SCHEMA.read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    question = write_gate(tmp_path, sequences, build="", guardrails={"sequence": 1.2})
    results = tmp_path / "results"

    # an identical result, an undecided one, and one with an interval and a broken guardrail
    before = write_trajectories(tmp_path / "before", sequences, 0.01, runs=2)
    single = write_trajectories(tmp_path / "single", sequences, 0.05, seed=1)
    after = write_trajectories(tmp_path / "after", sequences, 0.05, runs=2, seed=2)
    gates.record(question, trajectories=before, results=results)
    for files in (before, single, after):
        made = gates.check(question, trajectories=files, results=results)
        written = json.loads((Path(made.folder) / "gate.json").read_text())
        assert list(validator.iter_errors(written)) == []
    assert written["low"] > 1.0

    for name, value in [("verdict", "fine"), ("ratio", "1.0"), ("unknown", 1), ("lost", [0])]:
        assert not validator.is_valid(written | {name: value}), name


def test_a_missing_trajectory_is_named(tmp_path, sequences) -> None:
    question = write_gate(tmp_path, sequences, build="")
    files = write_trajectories(tmp_path / "files", sequences[:1], 0.01)
    with pytest.raises(RunError) as caught:
        gates.record(question, trajectories=files)
    assert "two.txt" in caught.value.hint


# -- pytest ------------------------------------------------------------------------------------------------

CONFTEST = """
from pathlib import Path
from dynslam_bench import gate
from dynslam_bench.gate.result import GateResult

gate.check = lambda path, **options: GateResult.read(Path(path).with_name("result.json"))
"""
"""Puts a result in the place of a gate that runs for minutes."""


def run_pytest(folder, *options):
    """The exit code and the output of pytest in a folder with one test that takes the fixture."""
    (folder / "test_it.py").write_text("def test_gate(dynslam_gate): ...\n")
    is_installed = bool(entry_points(group="pytest11", name="dynslam-gate"))
    plugin = [] if is_installed else ["-p", "dynslam_bench.gate.pytest_plugin"]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *plugin, *options]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    return ended.returncode, ended.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verdict", "code"),
    [
        ("identical", 0),
        ("regressed", 4),
        ("undecided", 5),
        ("improved", 3),  # 3: some runs failed
    ],
)
def test_the_pytest_fixture_passes_only_where_the_gate_does(tmp_path, verdict, code) -> None:
    (tmp_path / "conftest.py").write_text(CONFTEST)
    result = gates.GateResult(
        verdict=verdict,
        exit_code=code,
        sentence="so it is",
        question="q",
        protocol="p",
        margin=0.1,
        baseline=Origin(name="a"),
        candidate=Origin(name="b"),
    )
    (tmp_path / "result.json").write_text(result.to_json())
    ended, text = run_pytest(tmp_path)
    passes = code == 0
    assert (ended == 0) is passes
    assert (f"**{verdict}**: so it is" in text) is not passes


@pytest.mark.slow
def test_without_a_question_a_test_fails_with_the_cure(tmp_path) -> None:
    ended, text = run_pytest(tmp_path)
    assert ended == 1
    assert "gate init" in text
