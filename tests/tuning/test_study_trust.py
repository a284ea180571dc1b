"""What a study's storage may do: hold numbers; it runs no code, and its password is nowhere written down."""

from __future__ import annotations

import json
import os
import pickle
import pickletools
import shutil
from pathlib import Path

import numpy as np
import pytest
from optuna.samplers import _cmaes as optuna_cmaes

from dynslam_bench.core.errors import StudyError
from dynslam_bench.tuning import Study
from dynslam_bench.tuning import storage as cmaes_state
from dynslam_bench.tuning.storage import open_storage
from dynslam_bench.tuning.study_file import StudySpec

SPEC = StudySpec(name="trust", tune=("synthetic/walking_xyz?frames=10",))


class Command:
    """What an attacker writes into a storage."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("touch owned",)


@pytest.fixture
def guarded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setattr(optuna_cmaes, "pickle", pickle)  # what is restricted here is as it was afterwards
    monkeypatch.chdir(tmp_path)
    cmaes_state.restrict()
    return tmp_path


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_a_storage_cannot_run_code_through_cmaes(guarded: Path, protocol: int) -> None:
    data = pickle.dumps(Command(), protocol)
    assert "REDUCE" in {operation.name for operation, _, _ in pickletools.genops(data)}
    with pytest.raises(StudyError, match=r"no state of CMA-ES but something else: it names (posix|nt|os)\.system"):
        optuna_cmaes.pickle.loads(data)
    assert not (guarded / "owned").exists()


@pytest.mark.parametrize(
    "name", [b"cbuiltins\neval\n.", b"cnumpy\nload\n.", b"cnumpy.core.multiarray\n_reconstruct.x\n.", b"x"]
)
def test_nothing_but_its_own_classes_is_restored(guarded: Path, name: bytes) -> None:
    with pytest.raises(StudyError, match="no state of CMA-ES"):
        optuna_cmaes.pickle.loads(name)


def test_a_few_bytes_cost_no_gigabytes(guarded: Path) -> None:
    """The number of a stored object is the length of the table that Python makes for them."""
    with pytest.raises(StudyError, match="it asks for room for 680813941 objects"):
        optuna_cmaes.pickle.loads(b"\x80\x04Nr" + (680813941).to_bytes(4, "little") + b".")


def test_its_own_state_comes_back(guarded: Path) -> None:
    cmaes = pytest.importorskip("cmaes")
    made = cmaes.CMA(mean=np.zeros(2), sigma=1.0, seed=1)
    made.tell([(made.ask(), float(k)) for k in range(made.population_size)])
    back = optuna_cmaes.pickle.loads(optuna_cmaes.pickle.dumps(made))
    assert back.generation == 1 and np.array_equal(back._mean, made._mean)


def test_an_optuna_that_reads_it_otherwise_is_refused(guarded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(optuna_cmaes, "pickle")
    with pytest.raises(StudyError, match="not known to be safe with this version of Optuna"):
        cmaes_state.restrict()


@pytest.mark.parametrize("storage", ["redis://host/0", "postgres", "file:///x", "s3://bucket"])
def test_storages_that_may_hold_code_are_refused(tmp_path: Path, storage: str) -> None:
    with pytest.raises(StudyError, match="is of no kind that is known"):
        open_storage(tmp_path, SPEC.model_copy(update={"storage": storage}))


@pytest.mark.parametrize(
    "address",
    ["postgresql://me:s3cret@127.0.0.1:9/x", "mysql+nothing://me:s3cret@host/x", "postgresql://me:s3%63ret@127.0.0.1:9/x",
     "grpc://me:s3cret@host"],
)  # fmt: skip
def test_the_password_is_in_no_error(tmp_path: Path, address: str) -> None:
    with pytest.raises(StudyError, match="cannot open the storage") as caught:
        open_storage(tmp_path, SPEC.model_copy(update={"storage": address}))
    assert "s3" not in str(caught.value) and caught.value.__cause__ is None


def test_the_password_is_in_nothing_that_is_stored() -> None:
    spec = SPEC.model_copy(update={"storage": "postgresql://me:s3cret@db/x"})
    assert spec.for_others()["storage"] == "postgresql://me:***@db/x"
    assert "s3cret" not in str(spec.for_others()) and "s3cret" not in spec.digest()


@pytest.mark.parametrize(
    "content",
    [b"\xff", b"[]", b"{", b'{"name": "../../x", "tune": ["a"]}', b'{"name": "' + b"a" * 300 + b'"}', b"[" * 10**5],
)
def test_a_damaged_stored_study_is_one_clear_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "study.json").write_bytes(content)
    with pytest.raises(StudyError, match=r"study\.json"):
        Study.open(tmp_path)


@pytest.mark.parametrize("value", ["", {}, [1], "x" * 400])
def test_a_journal_that_holds_no_trials_is_one_clear_line(tmp_path: Path, value: object) -> None:
    fixture = Path(__file__).resolve().parents[1] / "fixtures" / "before_rebuild" / "results" / "studies" / "small"
    study = shutil.copytree(fixture, tmp_path / "results" / "studies" / "small")
    assert len(Study.open(study).frame()) > 0
    lines = [json.loads(line) for line in (study / "journal.log").read_text().splitlines()]
    for line in lines:
        if "coverage" in line.get("user_attr", {}):
            line["user_attr"]["coverage"] = value
    (study / "journal.log").write_text("".join(json.dumps(line) + "\n" for line in lines))
    with pytest.raises(StudyError, match="holds what is no trial"):
        Study.open(study).frame()
