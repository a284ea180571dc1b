"""Compiled kernels on disk: nothing stale, foreign or damaged is used, and nothing is compiled twice."""

import importlib
import json
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from numba.core.compiler import Compiler

import dynslam_bench
from dynslam_bench.core import compiled, kernel_cache, kernel_code
from dynslam_bench.core.kernel_cache import KERNELS, UNUSED_S, load_kernels, remove_unused
from dynslam_bench.core.kernel_code import NotDescribedError, kernel_digest, signature_digest
from dynslam_bench.core.module_graph import ModuleGraph, module_files, module_graph

TOYS = {
    "toys/__init__.py": "",
    "toys/constants.py": '"""Numbers."""\nSCALE = 2.0\nOFFSETS = (1.0, 10.0)\nTABLE = [0.0]\nUNUSED = 1\n',
    "toys/inner.py": '''
from dynslam_bench.core.compiled import inlined, kernel, inlined_statements
from toys import constants
from toys.constants import OFFSETS

@inlined
def scaled(x):
    """Docs."""
    return constants.SCALE * x

@inlined_statements
def moved(x):
    return x + OFFSETS[1]

@kernel
def called(x, factor=1.0):
    return x * factor

@kernel
def first_of(pair):
    return pair.x
''',
    "toys/outer.py": '''
import numpy as np
from dynslam_bench.core.compiled import kernel
from toys.inner import called, moved, scaled

TABLE = np.array([100.0, 1000.0])

@kernel
def outer(x):
    """Docs."""
    return called(moved(scaled(x))) + TABLE[0]
''',
}
"""Kernels of which one uses all others; ``outer(3.0)`` is 2 * 3 + 10 + 100."""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of compiled kernels, empty; the toys are forgotten afterwards."""
    kernels = tmp_path / "kernels"
    monkeypatch.setenv("DYNSLAM_BENCH_CACHE", str(tmp_path))
    # two edits within a second look the same to Python
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    path = list(sys.path)
    yield kernels
    sys.path[:] = path
    forget_toys()


def forget_toys() -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "toys"]:
        del sys.modules[name]
    for function in [
        function for function in KERNELS if function.__module__.partition(".")[0] == "toys"
    ]:
        del KERNELS[function]


def write_toys(checkout: Path, *edits: tuple[str, str, str]) -> Path:
    """Write the toys into a folder, each edit (file, old, new) made."""
    sources = dict(TOYS)
    for file, old, new in edits:
        assert old in sources[file]
        sources[file] = sources[file].replace(old, new)
    for file, source in sources.items():
        (checkout / file).parent.mkdir(parents=True, exist_ok=True)
        (checkout / file).write_text(source)
    return checkout


def outer_kernel(checkout: Path) -> Any:
    """The outermost toy, imported as a new process would."""
    forget_toys()
    importlib.invalidate_caches()
    sys.path.insert(0, str(checkout))
    return importlib.import_module("toys.outer").outer


@pytest.fixture
def refuse(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Let numba compile nothing more."""

    def compile_extra(self: Compiler, func: Any) -> None:
        raise AssertionError(f"{func.__qualname__} is compiled")

    return lambda: monkeypatch.setattr(Compiler, "compile_extra", compile_extra)


def names(folder: Path) -> set[str]:
    return {file.name for file in folder.iterdir()}


# -- edits -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("edit", "result"),
    [
        (("toys/outer.py", "TABLE[0]", "TABLE[1]"), 1016.0),
        (("toys/outer.py", "100.0, 1000.0", "200.0, 1000.0"), 216.0),
        (("toys/outer.py", "called(moved(", "moved(called("), 116.0),
        (("toys/inner.py", "x * factor", "x / factor - 1"), 115.0),
        (("toys/inner.py", "factor=1.0", "factor=2.0"), 132.0),
        (("toys/inner.py", "x + OFFSETS", "x - OFFSETS"), 96.0),
        (("toys/inner.py", "OFFSETS[1]", "OFFSETS[0]"), 107.0),
        (("toys/inner.py", "constants.SCALE", "-constants.SCALE"), 104.0),
        (("toys/constants.py", "SCALE = 2.0", "SCALE = 3.0"), 119.0),
        (("toys/constants.py", "SCALE = 2.0", "SCALE = 2"), 116.0),
        (("toys/constants.py", "(1.0, 10.0)", "(1.0, 20.0)"), 126.0),
    ],
)
def test_an_edit_of_anything_that_is_compiled_in_takes_effect_at_once(
    edit: tuple[str, str, str], result: float, folder: Path, tmp_path: Path
) -> None:
    assert outer_kernel(write_toys(tmp_path / "toys"))(3.0) == 116.0
    before = names(folder)
    assert outer_kernel(write_toys(tmp_path / "toys", edit))(3.0) == result
    assert any("outer" in name for name in names(folder) - before)


@pytest.mark.slow
@pytest.mark.parametrize(
    "edit",
    [
        ("toys/outer.py", '"""Docs."""', '"""Other docs,\n\n    of several lines.\n    """'),
        ("toys/outer.py", '    """Docs."""\n', ""),
        ("toys/outer.py", "@kernel", "\n\n# a comment\n@kernel"),
        ("toys/inner.py", '"""Docs."""', '"""Other docs."""  # a comment'),
        ("toys/inner.py", "return x + OFFSETS[1]", "# a comment\n    return (x + OFFSETS[1])"),
        ("toys/constants.py", '"""Numbers."""', '"""Other numbers."""\n\n'),
        ("toys/constants.py", "UNUSED = 1", "UNUSED = 2"),
        ("toys/constants.py", "TABLE = [0.0]", "TABLE = [1.0]"),
    ],
)
def test_an_edit_of_what_is_not_compiled_in_compiles_nothing(
    edit: tuple[str, str, str], folder: Path, tmp_path: Path, refuse: Callable[[], None]
) -> None:
    assert outer_kernel(write_toys(tmp_path / "toys"))(3.0) == 116.0
    before = names(folder)
    refuse()
    assert outer_kernel(write_toys(tmp_path / "toys", edit))(3.0) == 116.0
    assert names(folder) == before


@pytest.mark.slow
def test_checkouts_with_equal_sources_share_what_is_compiled(
    folder: Path, tmp_path: Path, refuse: Callable[[], None]
) -> None:
    other = ("toys/constants.py", "SCALE = 2.0", "SCALE = 5.0")
    assert outer_kernel(write_toys(tmp_path / "one"))(3.0) == 116.0
    assert outer_kernel(write_toys(tmp_path / "other", other))(3.0) == 125.0
    before = names(folder)
    refuse()
    assert outer_kernel(write_toys(tmp_path / "copy"))(3.0) == 116.0
    assert outer_kernel(write_toys(tmp_path / "copy of the other", other))(3.0) == 125.0
    assert names(folder) == before


def test_a_constant_that_was_changed_in_memory_counts_as_changed(tmp_path: Path) -> None:
    patched = outer_kernel(write_toys(tmp_path / "toys"))
    sys.modules["toys.constants"].SCALE = 4.0  # type: ignore[attr-defined]
    assert patched(3.0) == 122.0
    assert outer_kernel(tmp_path / "toys")(3.0) == 116.0


@pytest.mark.slow
def test_an_option_of_the_decorator_counts(tmp_path: Path) -> None:
    inverted = ("toys/inner.py", "x * factor", "factor / (x - 16)")
    with pytest.raises(ZeroDivisionError):
        outer_kernel(write_toys(tmp_path / "toys", inverted))(3.0)
    decorator = [
        ("toys/inner.py", "import inlined, kernel", "import dividing_kernel, inlined"),
        ("toys/inner.py", "@kernel", "@dividing_kernel"),
    ]
    assert outer_kernel(write_toys(tmp_path / "toys", inverted, *decorator))(3.0) == np.inf


def test_a_division_by_zero_is_an_error_unless_asked_for() -> None:
    @compiled.dividing_kernel
    def like_numpy(x: float) -> float:
        return 1.0 / x

    @compiled.kernel
    def like_python(x: float) -> float:
        return 1.0 / x

    assert like_numpy(0.0) == np.inf
    with pytest.raises(ZeroDivisionError):
        like_python(0.0)


def test_kernels_are_compiled_to_release_the_gil(tmp_path: Path) -> None:
    assert outer_kernel(write_toys(tmp_path / "toys")).targetoptions["nogil"]


def test_a_kernel_divides_as_it_was_asked_to_whoever_calls_it_first() -> None:
    @compiled.kernel
    def inverse(x: float) -> float:
        return 1.0 / x

    @compiled.dividing_kernel
    def plus_one(x: float) -> float:
        return inverse(x) + 1.0

    assert plus_one(2.0) == 1.5
    with pytest.raises(ZeroDivisionError):
        inverse(0.0)


class Pair(NamedTuple):
    first: float
    second: float


class Turned(NamedTuple):
    second: float
    first: float


def test_the_fields_of_a_tuple_that_is_passed_count() -> None:
    Turned.__name__ = Turned.__qualname__ = "Pair"
    flags = numba.core.compiler.Flags()
    kinds = [numba.typeof(kind(1.0, 2.0)) for kind in (Pair, Turned)]
    assert str(kinds[0]) == str(kinds[1])
    assert len({signature_digest((kind,), None, flags) for kind in kinds}) == 2


@pytest.mark.parametrize(
    ("setting", "value", "same"),
    [
        ("OPT", 1, False),
        ("BOUNDSCHECK", 1, False),
        ("LOOP_VECTORIZE", 0, False),
        ("DISABLE_INTEL_SVML", 1, False),
        ("NUMBA_NUM_THREADS", 7, True),
        ("CACHE_DIR", "elsewhere", True),
    ],
)
def test_settings_of_numba_count_if_they_change_the_code(
    setting: str, value: object, same: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    kernel = outer_kernel(write_toys(tmp_path / "toys"))
    before = kernel_digest(kernel)
    monkeypatch.setattr(numba.config, setting, value)
    assert (kernel_digest(kernel) == before) is same


@pytest.mark.parametrize("owner", ["numba", "llvmlite", "np"])
def test_versions_count(owner: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    kernel = outer_kernel(write_toys(tmp_path / "toys"))
    before = kernel_digest(kernel)
    monkeypatch.setattr(getattr(kernel_code, owner), "__version__", "0.1")
    assert kernel_digest(kernel) != before


def test_the_processor_counts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    kernel = outer_kernel(write_toys(tmp_path / "toys"))
    before = kernel_digest(kernel)
    system, _, _ = kernel.targetctx.codegen().magic_tuple()
    monkeypatch.setattr(
        type(kernel.targetctx.codegen()), "magic_tuple", lambda _: (system, "x86-64-v3", "")
    )
    assert kernel_digest(kernel) != before


# -- files -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "damage",
    [
        lambda content, _: b"",
        lambda content, _: content[:10],
        lambda content, _: content[: len(content) // 2],
        lambda content, _: content[:-1],
        lambda content, _: content[:-2000] + b"\0" + content[-1999:],
        lambda content, _: content + b".",
        lambda content, other: other,
    ],
    ids=["empty", "header", "half", "without its end", "one byte", "too long", "another kernel's"],
)
def test_damaged_and_foreign_files_are_compiled_again(
    damage: Callable[[bytes, bytes], bytes], folder: Path, tmp_path: Path
) -> None:
    outer_kernel(write_toys(tmp_path / "toys"))(3.0)
    whole = {file: file.read_bytes() for file in folder.iterdir()}
    other = ("toys/constants.py", "SCALE = 2.0", "SCALE = 5.0")
    outer_kernel(write_toys(tmp_path / "toys", other))(3.0)
    foreign = next(file.read_bytes() for file in folder.glob("toys.outer*") if file not in whole)
    for file, content in whole.items():
        file.write_bytes(damage(content, foreign))
    assert outer_kernel(write_toys(tmp_path / "toys"))(3.0) == 116.0
    for file in whole:
        assert kernel_cache._read(file) is not None


def test_kernels_compile_where_nothing_can_be_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("DYNSLAM_BENCH_CACHE", str(tmp_path / "file"))
    assert outer_kernel(write_toys(tmp_path / "toys"))(3.0) == 116.0
    load_kernels()


def test_kernels_compile_for_a_user_without_a_home(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def no_folder() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(kernel_cache, "kernels_folder", no_folder)
    assert outer_kernel(write_toys(tmp_path / "toys"))(3.0) == 116.0


def test_kernels_compile_on_a_full_disk_and_leave_nothing_behind(
    folder: Path, tmp_path: Path
) -> None:
    kernel = outer_kernel(write_toys(tmp_path / "toys"))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        assert kernel(3.0) == 116.0
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert names(folder) == set()


def test_kernels_that_nobody_has_loaded_for_thirty_days_go(folder: Path, tmp_path: Path) -> None:
    kernel = outer_kernel(write_toys(tmp_path / "toys"))
    kernel(3.0)
    kernel(3)
    (folder / "somebody's file").touch()
    old, *others = sorted(folder.glob("toys.*"))
    now = others[0].stat().st_mtime
    os.utime(old, (now, now - UNUSED_S + 60))
    remove_unused(folder, now)
    assert old.exists()
    remove_unused(folder, now + 120)
    assert names(folder) == {file.name for file in others} | {"somebody's file"}
    remove_unused(folder / "missing", now)


def test_loading_is_a_use(folder: Path, tmp_path: Path) -> None:
    outer_kernel(write_toys(tmp_path / "toys"))(3.0)
    for file in folder.iterdir():
        os.utime(file, (0, 0))
    outer_kernel(tmp_path / "toys")(3.0)
    assert {file.name.partition("-")[0] for file in folder.iterdir() if file.stat().st_mtime} == {
        "toys.outer.outer"
    }


def test_kernels_on_disk_are_loaded_before_they_are_called(
    folder: Path, tmp_path: Path, refuse: Callable[[], None]
) -> None:
    outer_kernel(write_toys(tmp_path / "toys"))(3.0)
    damaged = next(folder.glob("toys.inner.called*"))
    damaged.write_bytes(damaged.read_bytes()[:-1])
    refuse()
    again = outer_kernel(tmp_path / "toys")
    load_kernels()
    assert again.signatures == [(numba.float64,)]
    assert sys.modules["toys.inner"].called.signatures == []  # type: ignore[attr-defined]


def test_kernels_for_types_that_are_gone_are_passed_over(folder: Path, tmp_path: Path) -> None:
    """A kernel that is unchanged may lie there for a type that another version has renamed."""
    write_toys(tmp_path / "toys")
    types = tmp_path / "toys/toys/types_of_toys.py"
    types.write_text("from typing import NamedTuple\n\n\nclass Pair(NamedTuple):\n    x: float\n")
    outer_kernel(tmp_path / "toys")
    module = importlib.import_module("toys.types_of_toys")
    first = sys.modules["toys.inner"].first_of  # type: ignore[attr-defined]
    assert first(module.Pair(2.0)) == 2.0
    assert any("first_of" in name for name in names(folder))

    types.write_text(types.read_text().replace("Pair", "Couple"))
    again = outer_kernel(tmp_path / "toys")
    load_kernels()
    assert again(3.0) == 116.0


# -- the kernels of this package -------------------------------------------------------------------


def test_every_kernel_of_this_package_can_be_stored() -> None:
    for name, file in module_files().items():
        if "core.compiled import" in file.read_text(encoding="utf-8"):
            importlib.import_module(name)
    own = [
        kernel
        for function, kernel in KERNELS.items()
        if function.__module__.startswith("dynslam_bench.")
    ]
    assert len(own) > 60
    for kernel in own:
        assert len(kernel_digest(kernel)) == 64


def test_code_of_a_module_that_has_changed_since_its_import_is_not_stored(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from dynslam_bench.features.fast import list_corners  # uses instructions of its module

    instructions = "dynslam_bench.features.fast"
    kernel_code.source_digest.cache_clear()
    assert len(kernel_digest(list_corners)) == 64
    edited = dict(module_graph().modules)
    edited[instructions] = edited["dynslam_bench.core.folders"]
    monkeypatch.setattr(kernel_code, "read_module_graph", lambda: ModuleGraph(edited))
    kernel_code.source_digest.cache_clear()
    with pytest.raises(NotDescribedError, match=instructions):
        kernel_digest(list_corners)
    kernel_code.source_digest.cache_clear()


@pytest.mark.slow
def test_two_instructions_of_one_function_are_told_apart() -> None:
    from dynslam_bench.core import simd

    assert simd.load.__qualname__ == simd.load_bytes.__qualname__
    digests = {
        tuple(kernel_code._value_words(value, (), {})) for value in (simd.load, simd.load_bytes)
    }
    assert len(digests) == 2


DIGESTS = """
import json
from dynslam_bench.core.kernel_cache import KERNELS
from dynslam_bench.core.kernel_code import kernel_digest
from dynslam_bench.flow import orientation_maps, matching_cost
from dynslam_bench.slam import bundle_adjustment
print(json.dumps({f"{kernel.__module__}.{kernel.__name__}": kernel_digest(kernel) for kernel in KERNELS.values()}))
"""


def copied_checkout(folder: Path) -> Path:
    """The package in a folder of its own, from where it can be imported."""
    package = Path(dynslam_bench.__file__).parent
    shutil.copytree(
        package, folder / package.name, ignore=shutil.ignore_patterns("__pycache__", "weights")
    )
    return folder


def printed(code: str, checkout: Path) -> Any:
    """What code writes as JSON in a process that imports a checkout."""
    # edits of equal length within a second would leave byte code that looks up to date
    environment = {**os.environ, "PYTHONPATH": str(checkout), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


@pytest.mark.slow
def test_an_edit_counts_for_the_kernels_that_it_is_compiled_into(tmp_path: Path) -> None:
    package = copied_checkout(tmp_path) / "dynslam_bench"
    before = printed(DIGESTS, tmp_path)

    def changed_by(file: Path, old: str, new: str) -> set[str]:
        source = file.read_text()
        assert old in source
        file.write_text(source.replace(old, new))
        digests = printed(DIGESTS, tmp_path)
        file.write_text(source)
        return {
            name.removeprefix("dynslam_bench.") for name in before if digests[name] != before[name]
        }

    # a constant, where it is used
    layout = package / "flow" / "layout.py"
    assert changed_by(layout, "ANGLE_LOW = -6", "ANGLE_LOW = -5") == {"flow.matching_cost.describe"}

    # an inlined function
    solver = package / "geometry" / "gauss_newton.py"
    by_function = changed_by(solver, "pose[0, 0] * x", "2 * pose[0, 0] * x")
    assert {"slam.pose_optimisation._optimise", "slam.bundle_adjustment._adjust"} <= by_function
    maps = {"flow.orientation_maps.fine_levels", "flow.orientation_maps.coarse_levels"}
    assert not by_function & {*maps, "geometry.gauss_newton.apply_twist"}

    # instructions: their whole module counts, and what it imports
    common = package / "core" / "simd.py"
    by_common = changed_by(common, "width //= 2", "width = width // 2")
    assert {*maps, "flow.refinement.similarity_lucas_kanade"} <= by_common
    assert "geometry.gauss_newton.apply_twist" not in by_common
    instructions = package / "flow" / "histogram_vectors.py"
    by_instruction = changed_by(instructions, "DERIVATIVE_SHIFT = 11", "DERIVATIVE_SHIFT = 10")
    assert maps <= by_instruction
    assert "flow.refinement.similarity_lucas_kanade" not in by_instruction
    assert "geometry.gauss_newton.apply_twist" not in by_instruction
    assert not changed_by(
        instructions, "DERIVATIVE_SHIFT = 11", "DERIVATIVE_SHIFT = 11  # a comment"
    )


OPTIMISE = """
import json, os, sys
import numpy as np
from dynslam_bench.core.folders import kernels_folder
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.slam.pose_optimisation import Measurements, optimise_pose

rng = np.random.default_rng(0)
points = rng.uniform((-1, -1, 2), (1, 1, 5), (40, 3))
uv = 500 * points[:, :2] / points[:, 2:] + 320 + rng.normal(0, 1, (40, 2))
ones, none = np.ones(40), np.zeros(40)
camera = Camera(width=640, height=640, fx=500.0, fy=500.0, cx=320.0, cy=320.0)
estimate = optimise_pose(np.eye(4), points, Measurements(uv, none, ones, none), camera)
files = sorted(name for name in os.listdir(kernels_folder()) if name.startswith("slam.pose_optimisation._optimise-"))
print(json.dumps([estimate.T_cam_world[0, 3], files]))
"""


@pytest.mark.slow
def test_an_edited_checkout_optimises_poses_anew_and_a_copy_shares(tmp_path: Path) -> None:
    checkout = copied_checkout(tmp_path / "checkout")
    solver = checkout / "dynslam_bench" / "geometry" / "gauss_newton.py"
    first, compiled_first = printed(OPTIMISE, checkout)
    source = solver.read_text()
    solver.write_text(source.replace("pose[0, 0] * x", "0.999 * pose[0, 0] * x"))
    edited, compiled_edited = printed(OPTIMISE, checkout)
    assert edited != first
    # an earlier run of this test may have compiled both
    assert set(compiled_edited) >= set(compiled_first)

    # a comment, a docstring, an edit of another module, another folder: nothing is compiled
    solver.write_text(
        "# A comment.\n" + source.replace("Coordinates of a point", "The coordinates of a point")
    )
    unrelated = checkout / "dynslam_bench" / "geometry" / "camera.py"
    unrelated.write_text(unrelated.read_text() + "\nUNUSED = 1\n")
    copy = checkout.rename(tmp_path / "copy")
    assert printed(OPTIMISE, copy) == [first, compiled_edited]
