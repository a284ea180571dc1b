"""The bank: an archive of trajectories with checksums, through folders, git and manifests of published files."""

import csv
import json
import os
import re
import shutil
import subprocess
import zipfile
from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
from pathlib import Path
from threading import Event
from time import sleep

import numpy as np
import pytest
from envs_toys import TARGET
from typer.testing import CliRunner

from dynslam_bench import api as db
from dynslam_bench.cli.app import app
from dynslam_bench.core.errors import InfrastructureError, RunError
from dynslam_bench.geometry import Trajectory, se3, write_tum
from dynslam_bench.runs import RunSpec, RunStore, bank, import_trajectory, run_many

PUBLISHED = Path(__file__).resolve().parents[3] / "shared" / "data" / "trajectories"


def invoke(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture(scope="module")
def results(tmp_path_factory, toy_folder):
    """A results folder with two runs."""
    folder = tmp_path_factory.mktemp("bank") / "results"
    run_many(
        [RunSpec(tracker=TARGET, sequence=toy_folder, frames=(0, 8), seed=seed) for seed in (0, 1)], results=folder
    )
    return folder


@pytest.fixture
def made(results, tmp_path):
    """A bank of the two runs."""
    bank.add([results], tmp_path / "bank")
    return tmp_path / "bank"


@pytest.fixture
def remote(tmp_path, monkeypatch):
    """An empty bare repository, and an author for commits."""
    for role in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{role}_NAME", "A. Uthor")
        monkeypatch.setenv(f"GIT_{role}_EMAIL", "author@example.org")
    subprocess.run(["git", "init", "--quiet", "--bare", tmp_path / "bank.git"], check=True)
    return str(tmp_path / "bank.git")


def altered(folder, name="trajectory_online.txt"):
    """Changes a digit of the first file of a name."""
    file = sorted(folder.rglob(name))[0]
    file.write_text(file.read_text().replace("1", "2", 1))
    return file.relative_to(folder).as_posix()


def test_a_bank_is_a_results_folder_of_text_files(results, made):
    files = sorted(path.relative_to(made).as_posix() for path in made.rglob("*") if not path.is_dir())
    assert {Path(name).name for name in files} == {
        "SHA256SUMS", "run.json", "trajectory_online.txt", "trajectory_final.txt", "timestamps.txt", "groundtruth.txt"
    }  # fmt: skip
    if shutil.which("sha256sum"):
        subprocess.run(["sha256sum", "-c", "--quiet", "SHA256SUMS"], cwd=made, check=True)
    columns = ["run_id", "tracker", "coverage", "ate_rmse_m", "rpe_1f_trans_rmse_m"]
    assert RunStore(made).frame()[columns].equals(RunStore(results).frame()[columns])
    for run_id in RunStore(made).ids():
        record = json.loads((made / "runs" / run_id / "run.json").read_text())
        assert (record["command"], record["place"]) == ([], "")
    assert db.report(made, protocol="evo-as/v1").html.is_file()
    assert bank.verify(made) == []  # what was computed beside it is no fault
    again = bank.add([results], made)
    assert (again.added, len(again.stored), again.left_out) == ([], 2, [])


def test_two_who_add_at_once_lose_nothing(results, made, tmp_path, monkeypatch):
    """The second one comes while the first has copied its runs and not yet written their checksums."""
    merge, copied, target = bank.merge, Event(), tmp_path / "shared"

    def slow(*words, **options):
        merged = merge(*words, **options)
        copied.set()
        sleep(0.2)
        return merged

    first, second = RunStore(made).ids()
    for run_id in (first, second):
        shutil.copytree(made, tmp_path / run_id, ignore=shutil.ignore_patterns(*({first, second} - {run_id})))
    monkeypatch.setattr(bank, "merge", slow)
    with ThreadPoolExecutor() as pool:
        earlier = pool.submit(bank.add, [tmp_path / first], target)
        assert copied.wait(60)
        later = pool.submit(bank.add, [tmp_path / second], target)
        assert (earlier.result().added, later.result().added) == ([first], [second])
    assert bank.verify(target) == [] and RunStore(target).ids() == [first, second]


def test_trials_of_studies_are_left_out(results, tmp_path):
    store = RunStore(tmp_path / "with_trial")
    shutil.copytree(results, store.root)
    record = store.all()[0][0]
    (store.folder(record.run_id) / "run.json").write_text(
        record.model_copy(update={"study": "mine", "overrides": {"drift": 0.1}, "settings": {"drift": 0.1}}).to_json()
    )
    assert len(bank.add([store.root], tmp_path / "bank").added) == 1


FAULTS = {
    "changed": (altered, "trajectory_online.txt is not what SHA256SUMS says"),
    "missing": (lambda folder: sorted(folder.rglob("groundtruth.txt"))[0].unlink(), "groundtruth.txt is missing"),
    "not listed": (lambda folder: (folder / "runs" / "x.txt").write_text("x"), "runs/x.txt is not listed"),
    "a link": (lambda folder: (folder / "runs" / "x.txt").symlink_to("/etc/hostname"), "runs/x.txt is a link"),
}


@pytest.mark.parametrize("change, words", FAULTS.values(), ids=FAULTS)
def test_faults_are_named_and_such_a_bank_is_neither_taken_nor_given(made, remote, tmp_path, change, words):
    shutil.copytree(made, tmp_path / "sound")
    change(made)
    assert any(words in fault for fault in bank.verify(made))
    done = invoke("bank", "verify", made)
    assert done.exit_code == 4 and words in done.output
    for refused in (
        lambda: bank.pull(str(made), tmp_path / "other"),
        lambda: bank.pull(str(tmp_path / "sound"), made),
        lambda: bank.push(made, remote),
        lambda: bank.add([tmp_path / "sound"], made),
    ):
        with pytest.raises(RunError, match=words):
            refused()
    assert not (tmp_path / "other").exists()


def test_records_that_do_not_fit_are_named(made):
    """Their checksums are right: whoever changed them made those, too."""
    (first, second), store = RunStore(made).ids(), RunStore(made)
    record = store.read(first)
    changed = record.model_copy(update={"identity": record.identity | {"seed": 7}})
    (made / "runs" / first / "run.json").write_text(changed.to_json())
    (made / "runs" / second / "run.json").write_text("{")
    for timestamps in made.glob("sequences/*/timestamps.txt"):
        timestamps.unlink()
    names = sorted(path for part in ("runs", "sequences") for path in (made / part).rglob("*.*") if path.is_file())
    sums = (f"{sha256(path.read_bytes()).hexdigest()}  {path.relative_to(made)}\n" for path in names)
    (made / "SHA256SUMS").write_text("".join(sums))
    faults = bank.verify(made)
    assert len(faults) == 3 and second in faults[0]
    assert first in faults[1] and "id" in faults[1] and "stamps" in faults[2]


def test_through_a_bare_git_repository_and_back(made, remote, tmp_path, monkeypatch):
    assert len(bank.push(made, remote).added) == 2
    monkeypatch.chdir(Path(remote).parent)
    assert bank.push(made, Path(remote).name).added == []
    log = subprocess.run(["git", "-C", remote, "log", "--format=%s"], capture_output=True, text=True, check=True)
    assert log.stdout == "Add runs: 2\n"
    pulled = bank.pull(remote, tmp_path / "pulled")
    assert len(pulled.added) == 2 and bank.verify(tmp_path / "pulled") == []
    assert (tmp_path / "pulled" / "SHA256SUMS").read_bytes() == (made / "SHA256SUMS").read_bytes()


def test_a_submission_with_an_altered_trajectory_is_refused(made, remote, tmp_path):
    """Altered alone, its bank has a fault; with new checksums, it contradicts the bank that has the run."""
    bank.push(made, remote)
    altered(made)
    with pytest.raises(RunError, match="is not what SHA256SUMS says"):
        bank.push(made, remote)
    (made / "SHA256SUMS").unlink()
    lines = [f"{sha256((made / name).read_bytes()).hexdigest()}  {name}\n" for name in bank.Bank(made).files()]
    (made / "SHA256SUMS").write_text("".join(lines))
    pushed = bank.push(made, remote)
    assert pushed.added == [] and "another result" in pushed.left_out[0].reason
    assert invoke("bank", "push", made, remote).exit_code == 3


def test_what_a_full_disk_cut_short_is_a_bank_and_can_be_gone_on_with(results, tmp_path, monkeypatch):
    copies = []

    def copy_one(source, target):
        copies.append(target)
        if len(copies) == 3:
            raise OSError(28, "No space left on device")
        Path(target).write_bytes(Path(source).read_bytes())

    monkeypatch.setattr(bank.shutil, "copyfile", copy_one)
    with pytest.raises(InfrastructureError, match="No space left"):
        bank.add([results], tmp_path / "bank")
    assert bank.verify(tmp_path / "bank") == [] and len(RunStore(tmp_path / "bank").ids()) == 1
    assert len(bank.add([results], tmp_path / "bank").added) == 1


@pytest.mark.parametrize("file", ["trajectory_online.txt", "timestamps.txt", "groundtruth.txt"])
def test_text_that_is_no_trajectory_is_a_fault_though_its_checksum_fits(made, file):
    path = sorted(made.rglob(file))[0]
    path.write_text("total garbage\n")
    sums = (made / "SHA256SUMS").read_text().splitlines()
    name = path.relative_to(made).as_posix()
    sums = [f"{sha256(path.read_bytes()).hexdigest()}  {name}" if name in line else line for line in sums]
    (made / "SHA256SUMS").write_text("\n".join(sums) + "\n")
    assert bank.verify(made) and all("runs/" in fault for fault in bank.verify(made))


def test_a_repository_of_something_else_gets_no_bank(made, remote, tmp_path):
    subprocess.run(["git", "clone", "--quiet", remote, tmp_path / "code"], check=True, capture_output=True)
    (tmp_path / "code" / "main.py").write_text("")
    for words in (
        ["add", "main.py"],
        ["commit", "--quiet", "--message", "Begin"],
        ["push", "--quiet", "origin", "HEAD"],
    ):
        subprocess.run(["git", *words], cwd=tmp_path / "code", check=True)
    with pytest.raises(RunError, match=r"is no bank: it has no SHA256SUMS, and holds main\.py"):
        bank.push(made, remote)


def test_an_archive_is_pulled_from_its_address(made, tmp_path, monkeypatch):
    def download(url, target):
        assert url == "https://example.org/bank.zip"
        with zipfile.ZipFile(target, "w") as archive:
            for path in made.rglob("*"):
                archive.write(path, Path("bank-main") / path.relative_to(made))

    monkeypatch.setattr(bank, "download", download)
    assert len(bank.pull("https://example.org/bank.zip", tmp_path / "pulled").added) == 2


def walk(folder, drift=0.0):
    """A trajectory file of 50 poses."""
    stamps = 100 + np.arange(50) / 30
    motions = np.stack([se3.exp(np.array([0.01 * i, drift * np.sin(i), 0, 0, 0.01 * i, 0])) for i in range(50)])
    write_tum(folder, Trajectory(stamps, motions))
    return folder.name, sha256(folder.read_bytes()).hexdigest()


def test_a_manifest_names_trajectories_of_sequences_that_are_not_here(tmp_path):
    (truth, _), (file, digest) = walk(tmp_path / "truth.txt"), walk(tmp_path / "theirs.txt", drift=0.01)
    entry = f'file = "{file}"\ntracker = "theirs"\nsequence = "tum/fr3/walking_xyz"\ntruth = "{truth}"\n'
    (tmp_path / "manifest.toml").write_text(
        f'[[trajectory]]\n{entry}sha256 = "{digest}"\nprovenance = "page 7"\n'
        f'[[trajectory]]\n{entry}sha256 = "{"0" * 64}"\n'
    )
    added = bank.add([tmp_path / "manifest.toml"], tmp_path / "bank")
    assert len(added.added) == 1 and f"checksum {digest}" in added.left_out[0].reason
    record = RunStore(tmp_path / "bank").read(added.added[0])
    assert (record.coverage, record.incomplete, record.provenance) == (None, False, "page 7")
    assert any("coverage is unknown" in note for note in record.notes) and "high-dynamic" in record.sequence.tags
    row = RunStore(tmp_path / "bank").frame().iloc[0]
    assert 0 < row["ate_rmse_m"] < 0.01 and row.isna()["coverage"]
    listed = invoke("runs", "list", "--results", tmp_path / "bank")
    assert listed.exit_code == 0 and "theirs" in listed.output
    page = db.report(tmp_path / "bank").html.read_text()
    assert "theirs" in page and "100.0 %" not in page
    with pytest.raises(RunError, match=r"unknown key .*sha265"):
        (tmp_path / "manifest.toml").write_text(f'[[trajectory]]\n{entry}sha256 = "{digest}"\nsha265 = ""\n')
        bank.add([tmp_path / "manifest.toml"], tmp_path / "bank")


def test_a_truth_of_another_time_is_refused(tmp_path):
    walk(tmp_path / "truth.txt")
    words = ["--tracker", "x", "--sequence", "mine", "--results", tmp_path / "r", "--truth", tmp_path / "truth.txt"]
    assert invoke("import", tmp_path / "truth.txt", *words).exit_code == 0
    (tmp_path / "other.txt").write_text("900 0 0 0 0 0 0 1\n901 0 0 0 0 0 0 1\n")
    with pytest.raises(RunError, match="shares 0 stamps"):
        import_trajectory(tmp_path / "other.txt", "x", "mine", truth=tmp_path / "truth.txt", results=tmp_path / "r")


TUM = {"freiburg1": "fr1", "freiburg3": "fr3"}


def sequence_of(folder):
    if "bonn" in folder:
        return "bonn/crowd"
    _, _, camera, name = folder.split("_", 3)
    return f"tum/{TUM[camera]}/{name}"


@pytest.mark.skipif(not PUBLISHED.is_dir(), reason="needs the authors' trajectories in ../shared/data/trajectories")
def test_published_trajectories_give_the_published_numbers_out_of_a_bank(tmp_path):
    """44 with numbers of their author, of which evo takes repeated stamps of the truth for five, and nine without."""
    singles = {
        "amos_slam/CameraTrajectory": "amos_slam", "cds_slam/walking_rpy": "walking_rpy",
        "ddn_slam/fr3_long_office": "long_office_household", "dyn_orb_slam/walking_xyz": "walking_xyz",
        "dyslam/walking_xyz": "walking_xyz", "lc_crf_slam/traject": "lc_crf_slam",
        "ygc_slam/CameraTrajectory": "walking_rpy", "yolo_dynaslam/walking_xyz": "walking_xyz",
        "yolo_slam_ywl0720/walking_xyz": "walking_xyz",
    }  # fmt: skip
    lines, numbers = [], {}

    def name(file, truth, tracker, sequence):
        lines.append(
            f'[[trajectory]]\nfile = "{file}"\nsha256 = "{sha256(file.read_bytes()).hexdigest()}"\n'
            f'tracker = "{tracker}"\nsequence = "{sequence}"\ntruth = "{truth}"\n'
        )

    for table in sorted(PUBLISHED.glob("rgbd-vo/*/published.csv")):
        for row in csv.DictReader(table.open()):
            tracker, sequence = Path(row["trajectory"]).stem, sequence_of(table.parent.name)
            name(table.parent / row["trajectory"], table.parent / "groundtruth.txt", tracker, sequence)
            numbers[tracker, sequence] = float(row["rmse_m"])
    for file, truth in singles.items():
        own = PUBLISHED / "authors" / truth
        where = own if own.is_dir() else PUBLISHED / "rgbd-vo" / f"rgbd_dataset_freiburg3_{truth}"
        sequence = {"amos_slam": "bonn/synchronous2", "lc_crf_slam": "tum/fr3/walking_xyz"}.get(truth) or sequence_of(
            where.name
        )
        name(PUBLISHED / "authors" / f"{file}.txt", where / "groundtruth.txt", file.partition("/")[0], sequence)
    (tmp_path / "manifest.toml").write_text("".join(lines))
    added = bank.add([tmp_path / "manifest.toml"], tmp_path / "bank")
    assert (len(added.added), added.left_out) == (53, []) and bank.verify(tmp_path / "bank") == []
    frame = RunStore(tmp_path / "bank").frame("evo-as/v1").set_index(["tracker", "sequence"])["ate_rmse_m"]
    assert len(frame) == 53 and frame.notna().all()
    differences = {key: abs(frame[key] - value) for key, value in numbers.items()}
    assert len(differences) == 44 and max(differences.values()) < 1e-6
    ranked = RunStore(tmp_path / "bank").frame("tum-rgbd/v1").set_index("tracker")["ate_rmse_m"]
    assert ranked["lc_crf_slam"] == pytest.approx(0.0221, abs=1e-4)


def test_git_is_needed_for_a_repository_alone(made, remote, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(RunError, match="git"):
        bank.push(made, remote)
    assert len(bank.push(made, str(tmp_path / "folder")).added) == 2
    assert os.environ["PATH"] == "/nowhere"


def test_the_shipped_manifest_is_one():
    """Every entry is pinned to a commit and a checksum."""
    entries = bank.read_manifest(Path(__file__).resolve().parents[2] / "docs" / "how-to" / "authors.toml")
    assert len(entries) == len({entry.sha256 for entry in entries}) == 13
    assert all(re.search("/[0-9a-f]{40}/", place) for entry in entries for place in (entry.file, entry.truth) if place)
    assert all(bool(entry.truth) == bool(entry.truth_sha256) for entry in entries)


@pytest.mark.skipif(not PUBLISHED.is_dir(), reason="needs the authors' trajectories in ../shared/data/trajectories")
def test_the_shipped_manifest_has_the_checksums_of_the_published_files():
    known = {sha256(path.read_bytes()).hexdigest() for path in PUBLISHED.rglob("*.txt")}
    entries = bank.read_manifest(Path(__file__).resolve().parents[2] / "docs" / "how-to" / "authors.toml")
    assert {digest for entry in entries for digest in (entry.sha256, entry.truth_sha256) if digest} <= known
