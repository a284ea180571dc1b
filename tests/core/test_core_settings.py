"""Settings: one annotation gives validation, overrides, search space and table; errors name what is wrong."""

import pickle
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Literal
from unittest.mock import Mock

import numpy as np
import pytest

import dynslam_bench
from dynslam_bench.core import (
    DynslamError,
    PluginError,
    SettingsError,
    did_you_mean,
    fingerprint,
    folders,
)
from dynslam_bench.core import plugins as plugin_probe
from dynslam_bench.core import version as versions
from dynslam_bench.core.code_files import files_below
from dynslam_bench.core.fingerprint import (
    content_digest,
    machine_digest,
    named_digests,
    opencv_version,
)
from dynslam_bench.core.plugins import ENVIRONMENT_VARIABLE, Registry, load_object
from dynslam_bench.core.settings import (
    Settings,
    apply_overrides,
    field_names,
    flatten,
    names,
    parameters,
    parse_assignments,
    settings_table,
    tunable,
)


class Epipolar(Settings):
    enabled: bool = tunable(True, meaning="whether to test")
    threshold_px: float = tunable(
        1.0, low=0.1, high=5.0, scale="log", unit="px", online=True, meaning="distance"
    )
    wide: float = tunable(
        1.0, low=0.5, high=2.0, limits=(0.0, None), meaning="validated more widely than searched"
    )


class Root(Settings):
    epipolar: Epipolar = Epipolar()
    features: int = tunable(1000, low=200, high=4000, meaning="keypoints")
    method: Literal["orb", "fast"] = tunable("orb", meaning="detector")
    when: Literal["rule", "now"] = tunable("rule", online=True, tuned=False, meaning="keyframes")
    name: str = "plain"
    maybe: float | None = None


def test_parameters_describe_the_search_space():
    by_name = {p.name: p for p in parameters(Root)}
    assert list(by_name) == [
        "epipolar.enabled",
        "epipolar.threshold_px",
        "epipolar.wide",
        "features",
        "method",
    ]
    threshold = by_name["epipolar.threshold_px"]
    assert (threshold.kind, threshold.low, threshold.high, threshold.scale) == (
        "float",
        0.1,
        5.0,
        "log",
    )
    assert by_name["features"].kind == "int"
    assert (by_name["epipolar.enabled"].choices, by_name["method"].choices) == (
        (False, True),
        ("orb", "fast"),
    )
    online = parameters(Root, online_only=True)
    assert [(p.name, p.tunable) for p in online] == [
        ("epipolar.threshold_px", True),
        ("when", False),
    ]
    assert online[1].choices == ("rule", "now")
    assert "`rule`, `now` |  | yes |" in settings_table(Root)


@pytest.mark.parametrize(
    ("assignment", "name", "value"),
    [
        ("epipolar.threshold_px=1.5", "epipolar.threshold_px", 1.5),
        ("features=500", "features", 500),
        ("epipolar.enabled=false", "epipolar.enabled", False),
        ("method=fast", "method", "fast"),
        ("name=a=b", "name", "a=b"),
        ("maybe=null", "maybe", None),
        (" features = 300 ", "features", 300),
        ("epipolar.wide=9", "epipolar.wide", 9.0),
    ],
)
def test_assignments_of_the_command_line(assignment, name, value):
    assert flatten(apply_overrides(Root(), parse_assignments([assignment]))) == flatten(Root()) | {
        name: value
    }


@pytest.mark.parametrize(
    ("assignment", "expected"),
    [
        (
            "epipolar.treshold_px=1",
            r"unknown setting 'epipolar.treshold_px' \(did you mean 'epipolar.threshold_px'",
        ),
        ("epipolar=1", r"setting 'epipolar' is a group \(set one of epipolar\.\*\)"),
        ("features.more=1", "unknown setting 'features.more'"),
        (
            "epipolar.threshold_px=9",
            r"setting 'epipolar.threshold_px' is 9: input should be less than or equal to 5",
        ),
        ("epipolar.threshold_px=nan", "setting 'epipolar.threshold_px' is"),
        ("epipolar.threshold_px=wide", r"is 'wide': input should be a valid number"),
        ("features=2.5", "setting 'features' is 2.5"),
        ("method=sift", "setting 'method' is 'sift': input should be 'orb' or 'fast'"),
        ("epipolar.wide=-1", "setting 'epipolar.wide' is -1"),
        ("features", "'features' is not an assignment"),
        ("=3", "'=3' is not an assignment"),
    ],
)
def test_bad_assignments_are_one_clear_line(assignment, expected):
    with pytest.raises(SettingsError, match=expected):
        apply_overrides(Root(), parse_assignments([assignment]))


@pytest.mark.parametrize("text", ["34", "true", "null", "[1]", '"quoted"', "1e3", "", "NaN"])
def test_a_text_stays_the_text_that_it_is(text):
    class Texts(Settings):
        name: str = ""
        file: Path | None = None
        either: float | str = 1.0
        choice: Literal["true", "34", 2] = 2

    assert apply_overrides(Texts(), {"name": text}).name == text
    assert apply_overrides(Texts(), parse_assignments([f"name={text}"])).name == text
    assert apply_overrides(Texts(), {"either": text}).either == text
    assert apply_overrides(Texts(), {"file": text}).file == (None if text == "null" else Path(text))
    if text in ("34", "true"):
        assert apply_overrides(Texts(), {"choice": text}).choice == text
    assert apply_overrides(Texts(choice="34"), {"choice": "2"}).choice == 2


def test_settings_are_frozen_and_tables_hold_every_leaf():
    with pytest.raises(Exception, match="frozen"):
        Root().features = 5
    table = settings_table(Root)
    assert table.count("\n") == 2 + len(field_names(Root))
    assert "| `epipolar.threshold_px` | `1.0` | 0.1 to 5 (log) | px | yes | distance |" in table
    assert '| `method` | `"orb"` | `orb`, `fast` |' in table


@pytest.mark.parametrize(
    ("kind", "default", "limits", "error", "words"),
    [
        (float, 1.0, {"low": 0.0, "high": 1.0, "scale": "log"}, ValueError, "log scale needs low > 0"),
        (float, 1.0, {}, TypeError, r"'value'.*needs low and high"),
        (
            float, 1000.0, {"low": 0.2, "high": 10.0, "limits": (0.0, 1e4)}, TypeError,
            r"Bad: the default of 'value' is 1000.0, outside its range 0.2 to 10",
        ),
        (Epipolar, Epipolar(wide=9.0), None, TypeError, "Bad: the default of 'value.wide' is 9.0, outside its"),
    ],
)  # fmt: skip
def test_bad_annotations_are_bugs_of_the_author(kind, default, limits, error, words):
    with pytest.raises(error, match=words):

        class Bad(Settings):
            value: kind = default if limits is None else tunable(default, meaning="x", **limits)


def test_a_group_with_other_defaults_is_described_with_them():
    class Other(Root):
        epipolar: Epipolar = Epipolar(threshold_px=2.5)

    defaults = [
        p.default
        for kind in (Other, Root)
        for p in parameters(kind)
        if p.name == "epipolar.threshold_px"
    ]
    assert defaults == [2.5, 1.0]
    assert "| `epipolar.threshold_px` | `2.5` |" in settings_table(Other)


@pytest.mark.parametrize(
    ("name", "names", "answer"),
    [
        ("walkin", ["walking", "sitting"], "did you mean 'walking'?"),
        ("TUM", ["tum", "x"], "did you mean 'tum'?"),
        ("qqq", ["a", "b"], "known: a, b"),
        ("qqq", [f"name{i}" for i in range(30)], "30 are known, none is close"),
        ("a", [], ""),
    ],
)
def test_did_you_mean(name, names, answer):
    assert did_you_mean(name, names) == answer


def test_errors_survive_a_process_border():
    again = pickle.loads(pickle.dumps(SettingsError("what", "how")))
    assert type(again) is SettingsError
    assert str(again) == "what (how)"
    assert str(DynslamError("only")) == "only"


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def test_content_digest_sees_type_shape_and_value() -> None:
    base = np.zeros((2, 3), np.uint8)
    assert (
        len({*map(content_digest, (base, base.reshape(3, 2), base.astype(np.int8), base + 1))}) == 4
    )
    assert content_digest(base) == content_digest(np.zeros((2, 6), np.uint8)[:, ::2])


class Inner(Settings):
    source: str = "auto"
    options: dict[str, object] = {}  # noqa: RUF012


class Whole(Settings):
    extractor: str = names("orb", "features", meaning="an id")
    vocabulary: str = names("", "file", meaning="a file", otherwise="FP_TEST_VOCABULARY")
    word: str = "orb"
    weights: Path | None = None
    gain: float = tunable(1.0, low=0, high=2, meaning="a number")
    inner: Inner = Inner()


def test_only_what_names_a_file_counts_as_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "orb").mkdir()
    write(tmp_path / "auto", "a file called like a setting")
    assert named_digests(Whole()) == {}, "a folder called like a word changes nothing"
    assert set(named_digests(Whole(), words=True)) == {"inner.source"}
    write(tmp_path / "fast", "a plug-in may open it")
    assert named_digests(Whole(word="fast")) == {}
    assert set(named_digests(Whole(word="fast"), words=True)) == {"inner.source", "word"}
    write(tmp_path / "fast,nets" / "small" / "net.onnx", "one")
    assert named_digests(Whole(word="fast,nets")) == {}
    of_folder = named_digests(Whole(word="fast,nets"), words=True)
    assert set(of_folder) == {"inner.source", "word"}
    write(tmp_path / "fast,nets" / "small" / "net.onnx", "two")
    assert named_digests(Whole(word="fast,nets"), words=True)["word"] != of_folder["word"]
    for index in range(200):
        write(tmp_path / "fast,nets" / f"{index}.png", "1111")
    assert set(named_digests(Whole(word="fast,nets"), words=True)) == {"inner.source"}, "data"
    for word in (".", "..", "\0", ""):
        assert set(named_digests(Whole(word=word), words=True)) == {"inner.source"}
    net = write(tmp_path / "net.onnx", "one")
    write(tmp_path / "voc.txt", "words")
    masks = write(tmp_path / "elsewhere" / "000000.png", "1111")
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "linked").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "masks" / "itself").symlink_to(tmp_path / "masks")
    options = {"network": {"file": str(net)}, "side": 3, "masks": "recorded:masks"}
    settings = Whole(
        vocabulary="voc.txt",
        word=str(net),
        weights=Path("net.onnx"),
        inner=Inner(source="onnx:net.onnx", options=options),
    )
    found = named_digests(settings)
    named = {
        "vocabulary",
        "word",
        "weights",
        "inner.source",
        "inner.options.network.file",
        "inner.options.masks",
    }
    assert set(found) == named
    assert len(set(found.values())) == 3
    net.write_text("three")
    masks.write_text("2222")
    assert {
        name for name, digest in named_digests(settings).items() if digest != found[name]
    } == named - {"vocabulary"}
    monkeypatch.setenv("FP_TEST_VOCABULARY", str(tmp_path / "voc.txt"))
    assert named_digests(Whole())["vocabulary"] == found["vocabulary"], "named by the environment"


class Listed(Settings):
    files: list[Path] = []  # noqa: RUF012
    pair: tuple[Path, ...] = ()
    table: dict[str, Path] = {}  # noqa: RUF012
    text: str = ""


@pytest.mark.parametrize(
    "settings",
    [
        Listed(files=[Path("first.bin"), Path("net.bin")]),
        Listed(pair=(Path("net.bin"), Path("first.bin"))),
        Listed(table={"weights": Path("net.bin")}),
        Listed(text="net.bin"),
        Listed(text="./net.bin"),
        Listed(text="$FP_TEST_FOLDER/net.bin"),
        Listed(text="${FP_TEST_FOLDER}"),
        Listed(table={"folder": Path("nets")}),
        Listed(text="nets/"),
    ],
)
def test_paths_count_in_every_form(
    settings: Listed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FP_TEST_FOLDER", str(tmp_path))
    files = [write(tmp_path / name, "1111") for name in ("net.bin", "nets/net.bin", "first.bin")]
    before = named_digests(settings)
    for file in files[:2]:
        file.write_text("2222")
    after = named_digests(settings)
    assert before.keys() == after.keys()
    assert before != after


@pytest.mark.parametrize("name", fingerprint.OPENCV)
def test_every_distribution_of_opencv_is_versioned(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def only(version: str):
        monkeypatch.setattr(
            fingerprint, "distribution_version", lambda asked: version if asked == name else ""
        )
        for cached in (opencv_version, machine_digest):
            cached.cache_clear()
        return opencv_version(), machine_digest()

    try:
        (first, machine) = only("4.10.0")
        (second, other) = only("4.11.0")
        assert first == f"{name} 4.10.0"
        assert second == f"{name} 4.11.0"
        assert machine != other
        monkeypatch.setattr(fingerprint, "distribution_version", lambda asked: "")
        opencv_version.cache_clear()
        assert opencv_version().startswith("cv2 "), "a build of one's own tells its version itself"
    finally:
        for cached in (opencv_version, machine_digest):
            cached.cache_clear()


def test_a_link_to_a_folder_above_it_is_not_followed(tmp_path):
    code = write(tmp_path / "inner" / "code.py", "")
    (tmp_path / "inner" / "up").symlink_to(tmp_path)
    assert list(files_below(tmp_path)) == [code]


# Where data, stages, weights and vocabularies lie, and the version of the package.


FOLDERS = {
    "data": folders.find_data_root,
    "stages": folders.stage_cache_folder,
    "digests": folders.digest_cache_folder,
    "kernels": folders.kernels_folder,
    "weights": folders.weights_folder,
    "vocabularies": folders.vocabularies_folder,
}
CACHES = ("stages", "digests", "kernels")
"""What ``DYNSLAM_BENCH_CACHE`` moves."""
VARIABLES = {
    "data": folders.DATA_VARIABLE,
    "stages": folders.STAGES_VARIABLE,
    "weights": folders.WEIGHTS_VARIABLE,
}


@pytest.fixture
def home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    for variable in (*VARIABLES.values(), "XDG_CACHE_HOME"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


@pytest.mark.parametrize(("platform", "cache"), [("linux", ".cache"), ("darwin", "Library/Caches")])
@pytest.mark.parametrize("name", FOLDERS)
def test_everything_lies_in_one_cache_folder(
    name: str, platform: str, cache: str, home: Path, monkeypatch
) -> None:
    monkeypatch.setattr(sys, "platform", platform)
    assert FOLDERS[name]() == home / cache / "dynslam-bench" / name
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / "elsewhere"))
    assert FOLDERS[name]() == home / "elsewhere" / "dynslam-bench" / name
    monkeypatch.setenv("XDG_CACHE_HOME", "~/elsewhere")
    assert FOLDERS[name]() == home / "elsewhere" / "dynslam-bench" / name


@pytest.mark.parametrize("name", VARIABLES)
def test_a_variable_moves_one_of_them(name: str, home: Path, monkeypatch) -> None:
    monkeypatch.setenv(VARIABLES[name], str(home / "mine"))
    moved = (
        {folder: home / "mine" / folder for folder in CACHES}
        if name == "stages"
        else {name: home / "mine"}
    )
    for folder, find in FOLDERS.items():
        assert find() == moved.get(folder, folders.user_cache() / folder)


@pytest.fixture
def fresh_version(monkeypatch: pytest.MonkeyPatch):
    versions.version.cache_clear()
    yield
    monkeypatch.undo()
    versions.version.cache_clear()


@pytest.mark.parametrize(
    ("installed", "release"),
    [
        ("0.1.0", "0.1.0"),
        ("0.1.1.dev5+g1a2b3c4.d20261122", "0.1.1"),
        ("0.1.dev1520+gabc", "0.1.0"),
        ("2.0", "2.0.0"),
        ("1.2rc1", "1.2.0"),
    ],
)
@pytest.mark.usefixtures("fresh_version")
def test_the_release_of_a_version(
    installed: str, release: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metadata, "version", lambda name: installed)
    assert (dynslam_bench.__version__, versions.release()) == (installed, release)


@pytest.mark.usefixtures("fresh_version")
def test_a_checkout_that_is_not_installed_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "version", Mock(side_effect=metadata.PackageNotFoundError))
    assert (dynslam_bench.__version__, versions.release()) == ("0+unknown", "0.0.0")


@dataclass(frozen=True)
class Spec:
    id: str
    entry_point: str = "json:loads"


SPEC_SOURCE = "from tests_plugin_contract import Spec\nSPEC = Spec('{id}')\nOTHER = 5\n"


@pytest.fixture(autouse=True)
def contract(monkeypatch):
    """Makes `Spec` importable by the plug-in files, and the environment clean."""
    monkeypatch.setitem(sys.modules, "tests_plugin_contract", SimpleNamespace(Spec=Spec))
    monkeypatch.delenv(ENVIRONMENT_VARIABLE, raising=False)


def registry(kind="trackers"):
    return Registry(kind, Spec, lambda: [Spec("built-in"), Spec("never-move")])


def fake_distribution(folder, group, targets, name="fake-dist"):
    info = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    lines = "".join(f"{key} = {target}\n" for key, target in targets.items())
    (info / "entry_points.txt").write_text(f"[{group}]\n{lines}")


@pytest.mark.slow
def test_file_and_module_targets(tmp_path, monkeypatch):
    file = write(tmp_path / "my_tracker.py", SPEC_SOURCE.format(id="mine"))
    assert registry().get(f"{file}:SPEC").id == "mine"
    monkeypatch.syspath_prepend(tmp_path)
    assert registry().get("my_tracker:SPEC").id == "mine"
    with pytest.raises(PluginError, match=r"is a int, not a Spec .name the spec, not the class"):
        registry().get(f"{file}:OTHER")
    with pytest.raises(PluginError, match=r"has no 'SPECC'.*did you mean 'SPEC' or 'Spec'"):
        registry().get(f"{file}:SPECC")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("target", "expected"),
    [
        ("nowhere.at.all:SPEC", "cannot import nowhere.at.all: ModuleNotFoundError"),
        (
            "/nowhere/file.py:SPEC",
            "cannot import /nowhere/file.py: FileNotFoundError: no file /nowhere/file.py",
        ),
        ("nocolon", "is not module:Attr"),
        (":SPEC", "is not module:Attr"),
        ("module:", "is not module:Attr"),
    ],
)
def test_targets_that_cannot_be_loaded(target, expected):
    with pytest.raises(PluginError, match=expected):
        load_object(target)


@pytest.mark.slow
def test_a_file_that_raises_gives_its_reason_and_can_be_mended(tmp_path):
    file = write(tmp_path / "broken.py", "raise RuntimeError('no GPU here')\n")
    with pytest.raises(PluginError, match="RuntimeError: no GPU here"):
        load_object(f"{file}:SPEC")
    file.write_text("SPEC = 7\n")
    assert load_object(f"{file}:SPEC") == 7


ENDINGS = {
    "import sys; sys.exit(0)": "exit code 0",
    "import os; os._exit(0)": "exit code 0",
    "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)": "SIGSEGV",
}


@pytest.mark.slow
@pytest.mark.parametrize("statement", ENDINGS)
def test_an_import_that_ends_the_process_is_an_error_like_any_other(
    tmp_path, monkeypatch, statement
):
    """As a file, as a module that the environment names, and as an entry point: the rest goes on."""
    (tmp_path / "ends_env.py").write_text(statement)
    (tmp_path / "ends_dist.py").write_text(statement)
    fake_distribution(tmp_path, "dynslam_bench.trackers", {"ends": "ends_dist:SPEC"}, "ends-dist")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, "ends_env:SPEC")
    with pytest.raises(
        PluginError, match=rf"that ends the process \({ENDINGS[statement]}\) .*sys.exit"
    ):
        load_object(f"{tmp_path / 'ends_env.py'}:SPEC")
    trackers = registry()
    assert len(trackers.all()) == 2
    reasons = [failure.reason for failure in trackers.failures()]
    assert len(reasons) == 2
    assert all(f"ends the process ({ENDINGS[statement]})" in reason for reason in reasons)


@pytest.mark.slow
def test_an_import_without_an_end_is_an_error_too(tmp_path, monkeypatch):
    monkeypatch.setattr(plugin_probe, "LIMIT_S", 1)
    (tmp_path / "endless.py").write_text("while True: pass\n")
    with pytest.raises(PluginError, match="is not done after 1 s"):
        load_object(f"{tmp_path / 'endless.py'}:SPEC")


@pytest.mark.slow
def test_environment_variable(tmp_path, monkeypatch):
    good = write(tmp_path / "good.py", SPEC_SOURCE.format(id="from-env"))
    broken = write(tmp_path / "broken.py", "import nothing_of_that_name\n")
    monkeypatch.setenv(
        ENVIRONMENT_VARIABLE, f"{good}:SPEC, flow={good}:SPEC,trackers={broken}:SPEC"
    )
    trackers = registry()
    assert [found.spec.id for found in trackers.all()] == ["built-in", "from-env", "never-move"]
    (failure,) = trackers.failures()
    assert str(broken) in failure.source
    assert "ModuleNotFoundError: No module named 'nothing_of_that_name'" in failure.reason
    assert [len(registry(kind).all()) for kind in ("flow", "filters")] == [3, 2]
    with pytest.raises(
        PluginError, match=r"unknown tracker 'brokn'.*broken\.py:SPEC failed to load: cannot import"
    ):
        trackers.get("brokn")
    monkeypatch.delenv(ENVIRONMENT_VARIABLE)
    assert len(trackers.all()) == 3  # discovered once
    trackers.refresh()
    assert len(trackers.all()) == 2
    assert trackers.failures() == []


@pytest.mark.slow
def test_entry_points_of_installed_distributions_come_after_the_environment_and_what_is_built_in(
    tmp_path, monkeypatch
):
    source = "from tests_plugin_contract import Spec\nGOOD, SAME, OTHER = Spec('from-dist'), Spec('same'), 5\n"
    (tmp_path / "dist_plugin.py").write_text(source + "BUILT_IN = Spec('never-move', 'a:b')\n")
    (tmp_path / "dist_broken.py").write_text(
        "raise OSError('libGL.so.1: cannot open shared object file')\n"
    )
    (tmp_path / "order_env.py").write_text(SPEC_SOURCE.format(id="same"))
    names = {"good": "GOOD", "number": "OTHER", "same": "SAME", "never": "BUILT_IN"}
    targets = {name: f"dist_plugin:{attribute}" for name, attribute in names.items()} | {
        "bad": "dist_broken:SPEC"
    }
    fake_distribution(tmp_path, "dynslam_bench.trackers", targets)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, "order_env:SPEC")
    trackers = registry()
    assert {found.spec.id: found.source for found in trackers.all()} == {
        "built-in": "built in",
        "never-move": "built in",
        "same": f"{ENVIRONMENT_VARIABLE}: order_env:SPEC",
        "from-dist": "entry point 'good' of fake-dist",
    }
    reasons = {failure.source: failure.reason for failure in trackers.failures()}
    for name, words in {
        "bad": "libGL.so.1",
        "number": "is a int",
        "same": "id 'same' is already taken by DYNSLAM_BENCH_PLUGINS: order_env:SPEC",
        "never": "id 'never-move' is already taken by built in",
    }.items():
        assert words in reasons[f"entry point '{name}' of fake-dist"]
    with pytest.raises(
        PluginError, match="failed to load: cannot import dist_broken: OSError: libGL"
    ):
        trackers.get("bad")
