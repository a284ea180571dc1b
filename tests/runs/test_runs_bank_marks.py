"""Rows of a bank that are run again, the checker of submissions, the index page; metadata; servers' archives."""

import csv
import json
import shutil
import subprocess
import sys
import zipfile
from hashlib import sha256
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.envs_toys import TARGET, write_folder
from typer.testing import CliRunner

from dynslam_bench.cli.app import app
from dynslam_bench.core.errors import DynslamError, RunError
from dynslam_bench.core.fingerprint import this_machine
from dynslam_bench.geometry import Trajectory, se3, write_tum
from dynslam_bench.runs import RunSpec, RunStore, bank, import_trajectory, reproducing, run_many
from dynslam_bench.runs.bank_files import BankDescription, Mark, read_description, read_marks
from dynslam_bench.runs.bank_index import INDEX_PAGE, bank_rows, write_bank_index
from dynslam_bench.runs.exchange.dataset_metadata import describe_data
from dynslam_bench.runs.exchange.server_archives import KITTI_SEQUENCES, _runs, write_server_archive
from dynslam_bench.runs.reproducing import _refuse_code_of_others, reproduce
from dynslam_bench.runs.submissions import CHECKER, check_submission
from dynslam_bench.sequences.catalogue import entry_of
from dynslam_bench.sequences.synthetic.ids import probe_id

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "trajectories"
OWN = SHARED / "modification_orb"
MINIMAL_RAI = (
    "rai:dataLimitations",
    "rai:dataBiases",
    "rai:personalSensitiveInformation",
    "rai:dataUseCases",
    "rai:dataSocialImpact",
    "rai:hasSyntheticData",
    "prov:wasDerivedFrom",
    "prov:wasGeneratedBy",
)
"""What NeurIPS's track of data sets asks for beside Croissant's own fields."""


def invoke(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


def walk(frames: int, drift: float = 0.0) -> Trajectory:
    """A camera that moves along and turns."""
    motions = [
        se3.exp(np.array([0.05 * i, drift * np.sin(i), 0, 0, 0.01 * i, 0])) for i in range(frames)
    ]
    return Trajectory(100 + np.arange(frames) / 30, np.stack(motions))


def sum_up(folder: Path) -> None:
    """Checksums of what a bank holds now, as whoever changed it would make them."""
    lines = [
        f"{sha256((folder / name).read_bytes()).hexdigest()}  {name}\n"
        for name in bank.Bank(folder).files()
    ]
    (folder / "SHA256SUMS").write_text("".join(lines))


@pytest.fixture
def imported(tmp_path: Path) -> Path:
    """A bank of one imported trajectory."""
    write_tum(tmp_path / "truth.txt", walk(30))
    write_tum(tmp_path / "theirs.txt", walk(30, drift=0.02))
    import_trajectory(
        tmp_path / "theirs.txt",
        "theirs",
        "tum/fr3/walking_xyz",
        truth=tmp_path / "truth.txt",
        results=tmp_path / "results",
    )
    bank.add([tmp_path / "results"], tmp_path / "bank")
    return tmp_path / "bank"


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    return write_folder(tmp_path_factory.mktemp("toy") / "toy")


@pytest.fixture(scope="module")
def runs(tmp_path_factory, recording) -> Path:
    """A results folder with two runs that are no repeats of each other in time, only in their seeds."""
    folder = tmp_path_factory.mktemp("runs") / "results"
    run_many(
        [
            RunSpec(tracker=TARGET, sequence=str(recording), frames=(0, 8), seed=seed)
            for seed in (0, 1)
        ],
        results=folder,
    )
    return folder


@pytest.fixture
def made(runs, tmp_path) -> Path:
    bank.add([runs], tmp_path / "bank")
    return tmp_path / "bank"


def mark_of(folder: Path, **changes) -> Mark:
    """A mark of a bank's first row."""
    values = {
        "run_id": RunStore(folder).ids()[0],
        "by": "b",
        "made": "2026-01-01T00:00:00+00:00",
        "machine": this_machine(),
        "protocol": "tum-rgbd/v1",
        "ate_m": 0.01,
        "ate_again_m": 0.01,
        "identical": True,
    }
    return Mark(**(values | changes))


def test_rows_are_imported_and_cannot_be_run_again(imported):
    (row,) = bank_rows(imported)
    assert row.standing == "imported"
    with pytest.raises(RunError, match=r"was imported from .*theirs\.txt: there is no run"):
        reproduce(imported, row.run_id, by="b")
    assert read_marks(imported)[0] == {}


@pytest.mark.slow
def test_an_equal_run_is_marked_and_the_row_says_by_how_many(made, recording, tmp_path):
    first, second = RunStore(made).ids()
    for by in ("b", "c"):
        done = reproduce(
            made, first, by=by, tracker=TARGET, sequence=str(recording), results=tmp_path / by
        )
        assert done.reproduced
        assert done.mark.identical
        assert done.mark.difference_m == 0
        assert "equal to the bit" in done.describe()
        assert done.mark.machine == this_machine()
    assert {row.run_id: row.standing for row in bank_rows(made)} == {
        first: "reproduced by 2",
        second: "own",
    }
    assert bank.verify(made) == []
    assert check_submission(made).accepted
    page, _ = write_bank_index(made)
    text = page.read_text()
    assert all(words in text for words in ("tum-rgbd/v1", "toy", "reproduced by 2", "equal to the"))
    # marks travel with their rows
    bank.push(made, str(tmp_path / "other"))
    assert read_marks(tmp_path / "other")[0].keys() == {first}
    assert len(read_marks(tmp_path / "other")[0][first]) == 2


@pytest.mark.slow
@pytest.mark.parametrize("shift_m", [0.0001, 0.5])
def test_a_run_that_differs_beyond_its_repeats_gets_no_mark(
    made, recording, tmp_path, monkeypatch, shift_m
):
    """Its error is another one, as on another machine: the repeats in the bank differ by 0.2 mm."""
    first = RunStore(made).ids()[0]
    monkeypatch.setattr(reproducing, "have_equal_files", lambda *_: False)
    errors = reproducing._error_of
    place = {"sequence": str(recording), "tracker": TARGET, "results": tmp_path / "again"}

    def shifted(store, record, description):
        shift = shift_m if store.root == tmp_path / "again" else 0.0
        return errors(store, record, description) + shift

    monkeypatch.setattr(reproducing, "_error_of", shifted)
    done = reproduce(made, first, by="b", **place)
    assert done.mark.difference_m == pytest.approx(shift_m)
    assert 0.0001 < done.mark.repeats_differ_m < 0.5
    assert done.reproduced == (shift_m < 0.5)
    assert len(read_marks(made)[0]) == done.reproduced
    if done.reproduced:
        assert bank.verify(made) == []
        return
    words = ["--by", "b", "--tracker", TARGET, "--sequence", recording, "--results"]
    refused = invoke("bank", "reproduce", made, first, *words, tmp_path / "again")
    assert refused.exit_code == 4
    assert "no mark" in refused.output


@pytest.mark.slow
def test_a_tracker_that_is_not_here_and_other_content_are_named(made, recording, tmp_path):
    first = RunStore(made).ids()[0]
    with pytest.raises(RunError, match=r"tracker 'toy' of row \w+ is code that only the row names"):
        reproduce(made, first, by="b", results=tmp_path / "again")
    other = write_folder(tmp_path / "toy", 9)
    with pytest.raises(RunError, match="has other content here"):
        reproduce(
            made, first, by="b", tracker=TARGET, sequence=str(other), results=tmp_path / "again"
        )


def test_a_machine_that_renders_other_bits_is_refused(made_of_rendered):
    """The bank says what its machine renders; another machine would have other errors."""
    first = RunStore(made_of_rendered).ids()[0]
    with pytest.raises(RunError, match=r"renders other bits: \S+ has the digest \w+, in the bank"):
        reproduce(made_of_rendered, first, by="b")


@pytest.fixture
def made_of_rendered(imported) -> Path:
    """The bank of an own run on a rendered sequence, on a machine that renders other bits."""
    store = RunStore(imported)
    (record,) = store.all()[0]
    sequence = record.sequence.model_copy(update={"id": "synthetic/walking_xyz?frames=30"})
    changed = record.model_copy(
        update={"kind": "run", "sequence": sequence, "identity": {}, "files": {}}
    )
    changed = changed.model_copy(update={"run_id": bank.run_id_of({})})
    folder = store.folder(record.run_id)
    (folder / "run.json").write_text(changed.to_json())
    (folder / "trajectory_final.txt").rename(folder / "trajectory_online.txt")
    folder.rename(store.folder(changed.run_id))
    (imported / "bank.json").write_text(
        BankDescription(probes={probe_id("walking_xyz"): "0" * 64}).to_json()
    )
    sum_up(imported)
    assert bank.verify(imported) == []
    return imported


MARKS = {
    "of no row": ({"run_id": "0" * 20}, "there is no row 0000"),
    "of another protocol": ({"protocol": "kitti"}, "it is under kitti, the bank under tum-rgbd/v1"),
    "beyond its repeats": (
        {"identical": False, "ate_again_m": 0.02, "repeats_differ_m": 0.001},
        r"differs by 10\.000 mm, beyond what its repeats",
    ),
    "equal and different": ({"ate_again_m": 0.02}, "says equal to the bit, and its errors differ"),
}


@pytest.mark.parametrize("changes, words", MARKS.values(), ids=MARKS)
def test_marks_that_do_not_fit_are_faults(imported, changes, words):
    mark = mark_of(imported, **changes)
    with pytest.raises(RunError, match=words):
        bank.add_mark(imported, mark)
    # written by hand, with checksums that fit
    file = imported / "marks" / mark.run_id / "b.json"
    file.parent.mkdir(parents=True)
    file.write_text(mark.to_json())
    sum_up(imported)
    (fault,) = bank.verify(imported)
    assert "marks/" in fault
    assert not check_submission(imported).accepted


def test_a_mark_whose_error_is_not_that_of_the_trajectory_is_refused(imported):
    bank.add_mark(imported, mark_of(imported))
    (fault,) = check_submission(imported).faults
    assert "the mark of b says 10.000 mm, the trajectory gives" in fault


def test_two_rows_of_one_id_are_named(imported):
    (run_id,) = RunStore(imported).ids()
    shutil.copytree(imported / "runs" / run_id, imported / "runs" / ("0" * 20))
    sum_up(imported)
    first = bank.verify(imported)[0]
    assert first == f"2 rows have the id {run_id}: runs/{'0' * 20}, runs/{run_id}"


def test_a_manifest_with_two_rows_of_one_id_keeps_the_first(tmp_path):
    write_tum(tmp_path / "truth.txt", walk(30))
    write_tum(tmp_path / "theirs.txt", walk(30, drift=0.02))
    table = '[[trajectory]]\nfile = "theirs.txt"\ntracker = "x"\nsequence = "mine"\ntruth = "truth.txt"\n'
    (tmp_path / "manifest.toml").write_text(table + table)
    merged = bank.add([tmp_path / "manifest.toml"], tmp_path / "bank")
    assert len(merged.added) == 1
    assert "the same trajectory of x as theirs.txt" in merged.left_out[0].reason


def test_banks_under_different_protocols_do_not_mix(imported, tmp_path):
    bank.add([tmp_path / "results"], tmp_path / "other", protocol="evo-as/v1")
    assert read_description(tmp_path / "other").protocol == "evo-as/v1"
    words = "one has the protocol"
    with pytest.raises(RunError, match=words):
        bank.pull(str(tmp_path / "other"), imported)
    (fault,) = check_submission(tmp_path / "other", imported).faults
    assert words in fault
    with pytest.raises(RunError, match=r"is a bank under tum-rgbd/v1, not kitti"):
        bank.add([tmp_path / "results"], imported, protocol="kitti")
    with pytest.raises(DynslamError, match="kiti"):
        bank.add([tmp_path / "results"], tmp_path / "third", protocol="kiti")


def test_the_checker_accepts_and_says_what_contradicts_the_bank(imported, tmp_path):
    done = invoke("bank", "check", imported)
    assert done.exit_code == 0
    assert f"{CHECKER}: {imported} is accepted: 1 rows, 1 new" in done.output
    shutil.copytree(imported, tmp_path / "theirs")
    assert check_submission(tmp_path / "theirs", imported).new == []
    # another trajectory under the row's id
    file = next((tmp_path / "theirs").rglob("trajectory_final.txt"))
    record = json.loads((file.parent / "run.json").read_text())
    file.write_text(file.read_text().replace("1", "2", 1))
    record["files"][file.name] = sha256(file.read_bytes()).hexdigest()
    (file.parent / "run.json").write_text(json.dumps(record))
    sum_up(tmp_path / "theirs")
    refused = invoke("bank", "check", tmp_path / "theirs", "--bank", imported)
    assert refused.exit_code == 4
    assert "the bank has a row of this id with another trajectory_final.txt" in refused.output
    assert invoke("bank", "check", tmp_path).exit_code == 1


def test_a_page_of_somebodys_own_is_not_overwritten(imported):
    (imported / INDEX_PAGE).write_text("mine\n")
    with pytest.raises(RunError, match="was not made by this command"):
        write_bank_index(imported)
    assert (imported / INDEX_PAGE).read_text() == "mine\n"


@pytest.mark.skipif(not OWN.is_dir(), reason="needs ../shared/data/trajectories/modification_orb")
def test_an_authors_numbers_of_tums_script_come_out_of_a_bank(tmp_path):
    """Eight trajectories with four numbers each, under the protocol that is TUM's script."""
    rows = list(csv.DictReader((OWN / "published.csv").open()))
    lines = []
    for row in rows:
        folder = OWN / row["sequence"]
        name = row["sequence"].replace("fr3_", "rgbd_dataset_freiburg3_")
        lines.append(
            f'[[trajectory]]\nfile = "{folder / row["trajectory"]}"\ntracker = "modification-orb"\n'
            f'sequence = "{entry_of(name).id}"\ntruth = "{folder / "groundtruth.txt"}"\n'
        )
        row["id"] = entry_of(name).id
    (tmp_path / "manifest.toml").write_text("".join(lines))
    assert len(bank.add([tmp_path / "manifest.toml"], tmp_path / "bank").added) == 8
    store = RunStore(tmp_path / "bank")
    metrics = {record.sequence.id: store.score(record).metrics for record in store.all()[0]}
    differences = [
        abs(metrics[row["id"]][f"ate_{name}_m"] - float(row[f"{name}_m"]))
        for row in rows
        for name in ("rmse", "mean", "median", "std")
    ]
    assert len(differences) == 32
    assert max(differences) < 1e-6


# -- data sets that describe themselves ------------------------------------------------------------


def minari(folder: Path) -> Path:
    """The metadata of a Minari data set."""
    (folder / "data").mkdir(parents=True)
    facts = {
        "dataset_id": "dynslam/masks-v0-static-v0",
        "env_spec": json.dumps({"id": "dynslam/SlamControl-v0"}),
        "total_episodes": 3,
        "total_steps": 60,
    }
    (folder / "data" / "metadata.json").write_text(json.dumps(facts))
    (folder / "data" / "main_data.hdf5").write_bytes(b"\x89HDF\r\n")
    return folder


def rendered(folder: Path) -> Path:
    """A folder as the renderer writes it."""
    for kind in ("rgb", "depth", "masks"):
        (folder / kind).mkdir(parents=True)
        (folder / kind / "1000.000000.png").write_bytes(b"\x89PNG")
        (folder / f"{kind}.txt").write_text(f"1000.000000 {kind}/1000.000000.png\n")
    write_tum(folder / "groundtruth.txt", walk(2), comment="exact poses of a rendered sequence")
    return folder


@pytest.fixture(params=["bank", "recordings of SLAM-Control", "rendered sequence"])
def data_set(request, tmp_path):
    """A data set of each kind, and its kind."""
    if request.param == "bank":
        return request.getfixturevalue("imported"), request.param
    if request.param == "rendered sequence":
        return rendered(tmp_path / "walking_xyz@0-01234567"), request.param
    return minari(tmp_path / "minari"), request.param


def test_metadata_and_card_are_written_from_the_same_facts(data_set):
    folder, kind = data_set
    done = describe_data(folder, url="https://example.org/data", creator="A group")
    assert done.kind == kind
    metadata = json.loads(done.croissant.read_text())
    assert all(metadata[name] not in (None, "", []) for name in MINIMAL_RAI)
    for entry in metadata["distribution"]:
        if entry["@type"] == "cr:FileObject":
            content = (folder / entry["contentUrl"]).read_bytes()
            assert entry["sha256"] == sha256(content).hexdigest()
        else:
            assert any(folder.glob(entry["includes"]))
    text = done.card.read_text()
    for name in ("rai:dataLimitations", "rai:dataBiases", "rai:dataUseCases"):
        assert metadata[name] in text
    assert "https://example.org/data" in text
    if kind == "bank":
        assert bank.verify(folder) == []


def test_metadata_are_valid_croissant(data_set):
    croissant = pytest.importorskip("mlcroissant", reason="mlcroissant is not installed")
    done = describe_data(data_set[0])
    dataset = croissant.Dataset(jsonld=done.croissant)
    assert not dataset.metadata.ctx.issues.errors
    assert not dataset.metadata.ctx.issues.warnings


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("[1]", "holds a list, expected an object"),
        ("3", "holds a int, expected an object"),
        ("{}", "names no environment of dynslam-bench in env_spec: nothing"),
        ('{"env_spec": "{\\"id\\": \\"PointMaze-v3\\"}"}', "PointMaze-v3"),
    ],
)
def test_other_data_of_minari_get_no_licence(content, words, tmp_path):
    folder = minari(tmp_path / "minari")
    (folder / "data" / "metadata.json").write_text(content)
    with pytest.raises(RunError, match=words):
        describe_data(folder)


@pytest.mark.parametrize("name", ["DATA_CARD.md", "croissant.json"])
def test_somebodys_own_card_and_metadata_stay(name, tmp_path):
    folder = minari(tmp_path / "minari")
    (folder / name).write_text("mine")
    with pytest.raises(RunError, match="was not made by this command, and stays"):
        describe_data(folder)
    assert (folder / name).read_text() == "mine"
    (folder / name).unlink()
    describe_data(folder)
    describe_data(folder)  # its own are replaced


@pytest.mark.parametrize(
    ("tracker", "overrides", "words"),
    [
        ({"id": "subprocess"}, {"command": "rm -rf ~"}, "runs a program of its author.*'rm -rf ~'"),
        ({"id": "batch"}, {"program": "theirs.toml"}, "runs a program of its author.*theirs.toml"),
        ({"id": "toy", "given": "theirs.py:SPEC"}, {}, "only the row names: 'theirs.py:SPEC'"),
        ({"id": "toy", "given": "theirs.slam:SPEC"}, {}, "only the row names: 'theirs.slam:SPEC'"),
        (
            {"id": "orb-slam2"},
            {"segmentation.source": "theirs.net:SPEC"},
            "setting segmentation.source .* 'theirs.net:SPEC'",
        ),
    ],
)
def test_code_that_only_a_row_names_is_shown_and_not_run(tracker, overrides, words, imported):
    record = RunStore(imported).all()[0][0]
    info = record.tracker.model_copy(update={"given": ""} | tracker)
    foreign = record.model_copy(update={"tracker": info, "overrides": overrides, "settings": {}})
    given = info.given or info.id
    with pytest.raises(RunError, match=words):
        _refuse_code_of_others(foreign, given, is_named=False)
    _refuse_code_of_others(foreign, f"{info.id}:mine", is_named=True)
    if info.id in ("subprocess", "batch"):
        with pytest.raises(RunError, match=words):
            _refuse_code_of_others(foreign, info.id, is_named=True)


def test_an_installed_tracker_with_plain_settings_runs_again(imported):
    record = RunStore(imported).all()[0][0]
    info = record.tracker.model_copy(update={"given": "", "id": "orb-slam2"})
    own = record.model_copy(update={"tracker": info, "overrides": {"a.b": "cuda:0", "c": 3}})
    _refuse_code_of_others(own, "orb-slam2", is_named=False)


def test_of_runs_with_one_seed_the_newest_is_sent_and_the_others_are_named(tmp_path):
    run_of_folder(tmp_path, "sofa_5")
    store = RunStore(tmp_path / "results")
    (first,) = store.all()[0]
    newest = first.model_copy(update={"run_id": "1" * 20, "started": "2026-11-29T12:00:00+00:00"})
    older = first.model_copy(update={"run_id": "2" * 20, "started": "2026-11-28T12:00:00+00:00"})
    invalid = newest.model_copy(update={"run_id": "3" * 20, "kind": "run", "identity": {}})
    records = [older, newest, invalid]
    for order in (records, records[::-1]):
        given = SimpleNamespace(all=lambda order=order: (order, []), source=store.source)
        chosen, notes = _runs(given, "eth3d", "mine")
        assert chosen["sofa_5"].run_id == newest.run_id
        assert older.run_id in notes[0]
        assert invalid.run_id in notes[0]


def test_another_folder_is_no_data_set(tmp_path):
    with pytest.raises(RunError, match="is no rendered sequence, no Minari data set and no bank"):
        describe_data(tmp_path)


# -- archives for servers --------------------------------------------------------------------------


def run_of_folder(tmp_path: Path, name: str, frames: int = 12) -> None:
    """An imported trajectory of ten of the frames of a folder."""
    write_tum(tmp_path / "truth.txt", walk(frames))
    write_tum(tmp_path / "track.txt", walk(frames, drift=0.01).select(np.arange(1, frames - 1)))
    import_trajectory(
        tmp_path / "track.txt",
        "mine",
        f"folder/{name}",
        truth=tmp_path / "truth.txt",
        results=tmp_path / "results",
    )


def test_an_archive_for_eth3d_has_a_file_in_tums_format_for_each_sequence(tmp_path):
    for name in ("cables_4", "sofa_5"):
        run_of_folder(tmp_path, name)
    target = tmp_path / "eth3d.zip"
    done = write_server_archive("eth3d", target, "mine", results=tmp_path / "results")
    with zipfile.ZipFile(target) as archive:
        assert archive.namelist() == ["cables_4.txt", "sofa_5.txt"]
        lines = archive.read("cables_4.txt").decode().splitlines()
    assert [len(line.split()) for line in lines] == [8] * 10
    assert sorted(done.runs) == ["cables_4.txt", "sofa_5.txt"]
    first = target.read_bytes()
    write_server_archive("eth3d", target, "mine", results=tmp_path / "results")
    assert target.read_bytes() == first


def test_an_archive_for_kitti_has_a_pose_of_each_frame_and_all_sequences(tmp_path):
    for name in KITTI_SEQUENCES[:-1]:
        run_of_folder(tmp_path, name)
    target = tmp_path / "kitti.zip"
    with pytest.raises(RunError, match="KITTI takes all of 11 to 21 together: 21 have no run"):
        write_server_archive("kitti", target, "mine", results=tmp_path / "results")
    assert not target.exists()
    run_of_folder(tmp_path, "21")
    done = write_server_archive("kitti", target, "mine", results=tmp_path / "results")
    with zipfile.ZipFile(target) as archive:
        assert archive.namelist() == [f"{name}.txt" for name in KITTI_SEQUENCES]
        rows = np.loadtxt(archive.read("11.txt").decode().splitlines())
    # frame 0 and the last one have none: they have that of their neighbour
    assert rows.shape == (12, 12)
    assert rows[0] == pytest.approx(np.eye(4)[:3].ravel())
    assert (rows[0] == rows[1]).all()
    assert (rows[-1] == rows[-2]).all()
    assert "11: 2 of 12 frames have no pose" in done.notes[0]


def test_wrong_names_of_servers_and_trackers_are_named(tmp_path):
    run_of_folder(tmp_path, "cables_4")
    results = tmp_path / "results"
    with pytest.raises(RunError, match="no server 'eht3d'"):
        write_server_archive("eht3d", tmp_path / "x.zip", "mine", results=results)
    with pytest.raises(RunError, match="'nobody' has no whole run on a sequence of eth3d"):
        write_server_archive("eth3d", tmp_path / "x.zip", "nobody", results=results)
    with pytest.raises(RunError, match=r"an archive is not written as 'x\.7z'"):
        write_server_archive("eth3d", tmp_path / "x.7z", "mine", results=results)


@pytest.mark.slow
def test_the_commands_name_what_they_wrote(imported, tmp_path):
    words = [sys.executable, "-m", "dynslam_bench", "bank", "index", str(imported)]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert "imported" in done.stdout
    assert INDEX_PAGE in done.stdout
