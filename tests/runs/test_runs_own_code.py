"""Which modules of this package count in a run's identity: those that it uses, and no others."""

import json
import os
import py_compile
import subprocess
import sys
from pathlib import Path

import pytest

from dynslam_bench.core import RunError
from dynslam_bench.core.module_graph import (
    PACKAGE,
    PLUMBING,
    ModuleGraph,
    check_byte_code,
    module_files,
    module_graph,
    read_module,
)
from dynslam_bench.runs import RunSpec, resolve
from dynslam_bench.runs.own_code import REGISTRY_MODULES, RESULT_NEUTRAL_MODULES, modules_of_run

pytestmark = pytest.mark.slow

SCENE = "synthetic/walking_xyz?scene=100&frames=6"
# Prints the modules of this package of which a function ran while a run was made in this process.
TRACER = """
import json, sys
from pathlib import Path
from dynslam_bench.core.module_graph import module_files
spec, folder = sys.argv[1:]
from dynslam_bench.evaluation import get_protocol
from dynslam_bench.runs.loop import run_loop
executed = set()
# it returns None: no lines are traced; a profiler would be told of every call of C code, too
sys.settrace(lambda frame, event, _: executed.add(frame.f_code.co_filename))
job = {"spec": json.loads(spec), "folder": folder, "progress_every": 3, "foreign": False}
run_loop(job | {"protocol": get_protocol("tum-rgbd/v1").model_dump(mode="json")}, lambda message: None, lambda: False)
sys.settrace(None)
names = {str(file): name for name, file in module_files().items()}
print(json.dumps(sorted(names[file] for file in executed if file in names)))
"""


def graph_of(**sources: str) -> ModuleGraph:
    """A graph of modules with these sources; a double underscore in a name stands for a dot."""
    named = {f"{PACKAGE}.{name.replace('__', '.')}": source for name, source in sources.items()}
    return ModuleGraph({name: read_module(name, source.encode()) for name, source in named.items()})


def test_a_closure_follows_imports_wherever_they_stand() -> None:
    graph = graph_of(
        a="from dynslam_bench import b\n",
        b="def f():\n    import dynslam_bench.c\n",
        c="if True:\n    from dynslam_bench.d import x\n",
        d="x = 1\n",
        e="import dynslam_bench.a\n",
    )
    assert graph.closure([f"{PACKAGE}.a"]) == [f"{PACKAGE}.{name}" for name in "abcd"]
    assert graph.closure([f"{PACKAGE}.a"], without=[f"{PACKAGE}.c"]) == [
        f"{PACKAGE}.a",
        f"{PACKAGE}.b",
    ]


def test_a_name_that_a_package_passes_on_counts_with_the_module_that_defines_it() -> None:
    graph = graph_of(
        user="from dynslam_bench.parts import wheel\n",
        parts="from dynslam_bench.parts.wheels import wheel\nfrom dynslam_bench.parts.doors import door\n",
        parts__wheels="wheel = 1\n",
        parts__doors="door = 2\n",
        other="from dynslam_bench.parts import own\n",
    )
    assert graph.closure([f"{PACKAGE}.user"]) == [f"{PACKAGE}.parts.wheels", f"{PACKAGE}.user"]
    whole_package = {
        f"{PACKAGE}.parts",
        f"{PACKAGE}.parts.wheels",
        f"{PACKAGE}.parts.doors",
        f"{PACKAGE}.other",
    }
    assert set(graph.closure([f"{PACKAGE}.other"])) == whole_package


@pytest.mark.parametrize(
    "source",
    [
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from dynslam_bench import b\n",
        'ENTRY_POINT = "dynslam_bench.b:Thing"\n',
        "import numpy\nfrom other.dynslam_bench import b\n",
    ],
)
def test_what_runs_nothing_is_no_import(source: str) -> None:
    graph = graph_of(a=source, b="x = 1\n")
    assert graph.closure([f"{PACKAGE}.a"]) == [f"{PACKAGE}.a"]


def test_two_packages_that_pass_a_name_to_each_other_come_to_an_end() -> None:
    graph = graph_of(
        a="from dynslam_bench.b import x\n",
        a__inner="",
        b="from dynslam_bench.a import x\n",
        b__inner="",
        user="from dynslam_bench.a import x\n",
    )
    assert f"{PACKAGE}.user" in graph.closure([f"{PACKAGE}.user"])


@pytest.mark.parametrize(
    ("edited", "changes"),
    [
        ("x = 1  # a note\n", False),
        ('"""What it is."""\nx  =  1\n', False),
        ("x = 2\n", True),
        ("x = 1\ny = 1\n", True),
    ],
)
def test_code_counts_by_its_syntax(edited: str, changes: bool) -> None:
    before = graph_of(a="from dynslam_bench.b import x\n", b="x = 1\n").digest([f"{PACKAGE}.a"])
    after = graph_of(a="from dynslam_bench.b import x\n", b=edited).digest([f"{PACKAGE}.a"])
    assert (before != after) is changes


def test_the_graph_knows_every_module_of_the_package() -> None:
    names = set(module_graph().modules)
    assert {
        f"{PACKAGE}.slam.tracking",
        f"{PACKAGE}.envs.slam_env",
        f"{PACKAGE}.core",
        PACKAGE,
    } <= names
    for name in module_files():
        assert "tests" not in name


def edited(graph: ModuleGraph, module: str) -> ModuleGraph:
    """The graph with an unused constant added to a module."""
    code = graph.modules[module]
    return ModuleGraph(
        {**graph.modules, module: type(code)(f"{code.digest} and more", code.imports, code.names)}
    )


@pytest.mark.parametrize(
    ("module", "changes"),
    [
        ("segmentation.training.labelled_images", False),
        ("segmentation.networks.mask_rcnn_segmenter", False),
        ("flow.label_search", False),
        ("culling.ego_motion", False),
        ("reports.build_report", False),
        ("tuning.study", False),
        ("cli.running", False),
        ("trackers.systems.published", False),
        ("sequences.readers.recorded", False),
        ("slam.tracking", True),
        ("geometry.gauss_newton", True),
        ("features.orb", True),
        ("sequences.synthetic.kernels", True),
        ("envs.slam_env", True),
    ],
)
def test_an_edit_changes_the_runs_that_use_the_module(module: str, changes: bool) -> None:
    run = resolve(RunSpec(tracker="orb-slam2", sequence=SCENE))
    parts = run.identity["parts"]
    before = module_graph()
    after = edited(before, f"{PACKAGE}.{module}")
    digests = {graph.code_digest(modules_of_run(graph, parts)) for graph in (before, after)}
    assert (len(digests) == 2) is changes


@pytest.mark.parametrize(
    ("tracker", "settings"),
    [
        ("never-move", {}),
        ("orb-slam2", {}),
        ("opencv-odometry", {}),
        ("mask-rcnn", {"segmentation.source": "oracle"}),
        ("emfoa-oft", {"segmentation.source": "embedded"}),
        ("emfoa-oft?masks=none", {"flow.method": "dis"}),
        ("dynaslam", {"segmentation.source": "oracle"}),
    ],
)
def test_every_module_that_runs_is_one_that_counts(
    tracker: str, settings: dict[str, str], tmp_path: Path
) -> None:
    run = resolve(RunSpec(tracker=tracker, sequence=SCENE, settings=settings))
    command = [sys.executable, "-c", TRACER, run.spec.model_dump_json(), str(tmp_path)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    executed = set(json.loads(done.stdout.splitlines()[-1]))
    beside = {
        PACKAGE,
        *PLUMBING,
        *(f"{PACKAGE}.{name}" for name in (*REGISTRY_MODULES, *RESULT_NEUTRAL_MODULES)),
    }
    # They only name what there is: the tables of trackers and of sequences, and the modules that
    # these read.
    finding = {f"{PACKAGE}.trackers.adapters.specs", f"{PACKAGE}.trackers.systems.emfoa_oft"}
    finding |= {f"{PACKAGE}.trackers.systems.published", f"{PACKAGE}.trackers.systems.composition"}
    counted = set(modules_of_run(module_graph(), run.identity["parts"]))
    assert executed - counted - beside - finding == set()


# Three edits of a module within the second in which it was compiled; the first two leave its
# length.
@pytest.mark.parametrize(
    ("text", "is_stale"), [("VALUE = 2", True), ("VALUE = 3", True), ("VALUE = 20", False)]
)
def test_byte_code_that_is_older_than_its_source_is_refused(
    text: str, is_stale: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "constants.py"
    source.write_text("VALUE = 1")
    second_ns = 1_700_000_000_000_000_000
    os.utime(source, ns=(second_ns, second_ns))
    byte_code = Path(py_compile.compile(str(source), doraise=True))
    os.utime(byte_code, ns=(second_ns, second_ns + 100_000_000))
    monkeypatch.setattr(
        "dynslam_bench.core.module_graph.module_files", lambda: {"dynslam_bench.constants": source}
    )
    check_byte_code.__wrapped__()

    source.write_text(text)
    os.utime(source, ns=(second_ns, second_ns + 500_000_000))
    if not is_stale:
        check_byte_code.__wrapped__()
        return
    with pytest.raises(RunError, match=r"byte code of dynslam_bench\.constants is older") as caught:
        check_byte_code.__wrapped__()
    assert f"touch {source}" in str(caught.value.hint)
    os.utime(source)  # the cure
    check_byte_code.__wrapped__()
