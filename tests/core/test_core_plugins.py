"""Plug-in discovery: every way in, in the stated order; a broken plug-in never breaks the rest."""

import sys
from dataclasses import dataclass

import pytest

from dynslam_bench.core import plugins as plugin_probe
from dynslam_bench.core.errors import PluginError
from dynslam_bench.core.plugins import ENVIRONMENT_VARIABLE, Registry, load_object


@dataclass(frozen=True)
class Spec:
    id: str
    entry_point: str = "json:loads"


SPEC_SOURCE = "from tests_plugin_contract import Spec\nSPEC = Spec('{id}')\nOTHER = 5\n"


@pytest.fixture(autouse=True)
def contract(monkeypatch):
    """Makes `Spec` importable by the plug-in files, and the environment clean."""
    module = type(sys)("tests_plugin_contract")
    module.Spec = Spec
    monkeypatch.setitem(sys.modules, "tests_plugin_contract", module)
    monkeypatch.delenv(ENVIRONMENT_VARIABLE, raising=False)


def registry(kind="trackers"):
    return Registry(kind, Spec, lambda: [Spec("built-in"), Spec("never-move")])


def fake_distribution(folder, group, targets, name="fake-dist"):
    info = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    lines = "".join(f"{key} = {target}\n" for key, target in targets.items())
    (info / "entry_points.txt").write_text(f"[{group}]\n{lines}")


def test_file_and_module_targets(tmp_path, monkeypatch):
    file = tmp_path / "my_tracker.py"
    file.write_text(SPEC_SOURCE.format(id="mine"))
    assert registry().get(f"{file}:SPEC").id == "mine"
    monkeypatch.syspath_prepend(tmp_path)
    assert registry().get("my_tracker:SPEC").id == "mine"
    with pytest.raises(PluginError, match=r"is a int, not a Spec .name the spec, not the class"):
        registry().get(f"{file}:OTHER")
    with pytest.raises(PluginError, match=r"has no 'SPECC'.*did you mean 'SPEC' or 'Spec'"):
        registry().get(f"{file}:SPECC")


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        ("nowhere.at.all:SPEC", "cannot import nowhere.at.all: ModuleNotFoundError"),
        ("/nowhere/file.py:SPEC", "cannot import /nowhere/file.py: FileNotFoundError: no file /nowhere/file.py"),
        ("nocolon", "is not module:Attr"),
        (":SPEC", "is not module:Attr"),
        ("module:", "is not module:Attr"),
    ],
)
def test_targets_that_cannot_be_loaded(target, expected):
    with pytest.raises(PluginError, match=expected) as caught:
        load_object(target)
    assert "\n" not in str(caught.value)


def test_a_file_that_raises_gives_its_reason_and_can_be_mended(tmp_path):
    file = tmp_path / "broken.py"
    file.write_text("raise RuntimeError('no GPU here')\n")
    with pytest.raises(PluginError, match="RuntimeError: no GPU here"):
        load_object(f"{file}:SPEC")
    file.write_text("SPEC = 7\n")
    assert load_object(f"{file}:SPEC") == 7


ENDINGS = {
    "import sys; sys.exit(0)": "exit code 0",
    "import os; os._exit(0)": "exit code 0",
    "raise SystemExit('no GPU')": "exit code 1",
    "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)": "SIGSEGV",
}


@pytest.mark.parametrize("statement", ENDINGS)
def test_an_import_that_ends_the_process_is_an_error_like_any_other(tmp_path, monkeypatch, statement):
    """As a file, as a module that the environment names, and as an entry point: the rest goes on."""
    (tmp_path / "ends_env.py").write_text(statement)
    (tmp_path / "ends_dist.py").write_text(statement)
    fake_distribution(tmp_path, "dynslam_bench.trackers", {"ends": "ends_dist:SPEC"}, "ends-dist")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, "ends_env:SPEC")
    with pytest.raises(PluginError, match=rf"that ends the process \({ENDINGS[statement]}\) .*sys.exit") as caught:
        load_object(f"{tmp_path / 'ends_env.py'}:SPEC")
    assert "\n" not in str(caught.value)
    trackers = registry()
    assert len(trackers.all()) == 2
    reasons = [failure.reason for failure in trackers.failures()]
    assert len(reasons) == 2 and all(f"ends the process ({ENDINGS[statement]})" in reason for reason in reasons)


def test_an_import_without_an_end_is_an_error_too(tmp_path, monkeypatch):
    monkeypatch.setattr(plugin_probe, "LIMIT_S", 3)
    (tmp_path / "endless.py").write_text("while True: pass\n")
    with pytest.raises(PluginError, match="is not done after 3 s"):
        load_object(f"{tmp_path / 'endless.py'}:SPEC")


def test_environment_variable(tmp_path, monkeypatch):
    good, broken = tmp_path / "good.py", tmp_path / "broken.py"
    good.write_text(SPEC_SOURCE.format(id="from-env"))
    broken.write_text("import nothing_of_that_name\n")
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, f"{good}:SPEC, flow={good}:SPEC,trackers={broken}:SPEC")
    trackers = registry()
    assert [found.spec.id for found in trackers.all()] == ["built-in", "from-env", "never-move"]
    (failure,) = trackers.failures()
    assert str(broken) in failure.source
    assert "ModuleNotFoundError: No module named 'nothing_of_that_name'" in failure.reason
    assert "from-env" in {found.spec.id for found in registry("flow").all()}
    assert "from-env" not in {found.spec.id for found in registry("filters").all()}
    monkeypatch.delenv(ENVIRONMENT_VARIABLE)
    assert len(trackers.all()) == 3  # found once
    trackers.refresh()
    assert len(trackers.all()) == 2
    assert trackers.failures() == []


def test_entry_points_of_installed_distributions(tmp_path, monkeypatch):
    (tmp_path / "dist_plugin.py").write_text(SPEC_SOURCE.format(id="from-dist"))
    (tmp_path / "dist_broken.py").write_text("raise OSError('libGL.so.1: cannot open shared object file')\n")
    targets = {"good": "dist_plugin:SPEC", "bad": "dist_broken:SPEC", "number": "dist_plugin:OTHER"}
    fake_distribution(tmp_path, "dynslam_bench.trackers", targets)
    monkeypatch.syspath_prepend(tmp_path)
    trackers = registry()
    sources = {found.spec.id: found.source for found in trackers.all()}
    assert sources["from-dist"] == "entry point 'good' of fake-dist"
    assert {"built-in", "never-move"} <= set(sources)
    reasons = {failure.source: failure.reason for failure in trackers.failures()}
    assert "libGL.so.1" in reasons["entry point 'bad' of fake-dist"]
    assert "is a int" in reasons["entry point 'number' of fake-dist"]
    with pytest.raises(PluginError, match="failed to load: cannot import dist_broken: OSError: libGL"):
        trackers.get("bad")
    assert trackers.get("from-dist").id == "from-dist"


def test_order_built_in_before_environment_before_entry_points(tmp_path, monkeypatch):
    (tmp_path / "order_env.py").write_text(SPEC_SOURCE.format(id="same"))
    (tmp_path / "order_dist.py").write_text(
        "from tests_plugin_contract import Spec\nSPEC = Spec('same')\nBUILT_IN = Spec('never-move', 'a:b')\n"
    )
    fake_distribution(
        tmp_path, "dynslam_bench.trackers", {"same": "order_dist:SPEC", "never": "order_dist:BUILT_IN"}, "order-dist"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, "order_env:SPEC")
    trackers = registry()
    sources = {found.spec.id: found.source for found in trackers.all()}
    assert sources["same"].startswith(ENVIRONMENT_VARIABLE)
    assert sources["never-move"] == "built in"
    taken = {failure.source: failure.reason for failure in trackers.failures()}
    assert (
        "id 'same' is already taken by DYNSLAM_BENCH_PLUGINS: order_env:SPEC"
        in taken["entry point 'same' of order-dist"]
    )
    assert "id 'never-move' is already taken by built in" in taken["entry point 'never' of order-dist"]
