"""Habits of the tests themselves: no test may pass without asserting; private names are asked for with a reason."""

from __future__ import annotations

import ast
import re
from collections.abc import Sequence
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
FILES = [file for file in sorted(TESTS.rglob("*.py")) if not {"fixtures", "benchmarks"} & set(file.parts)]
CERTAIN = {
    "test_exp_is_the_matrix_exponential": "it walks over the five twists that it makes",
    "test_replay_gives_the_files_poses": "it walks over the poses that it writes",
}
"""Tests with assertions in loops only, over what cannot be empty although the checker does not see it."""
PRIVATE = {
    "culling/blocks/test_culling_moving_vote.py": (
        {"_moving_corners"},
        "a box's corners decide the rule",
    ),
    "core/faults.py": ({"_exit"}, "os._exit: a fork that does not go on with the tests"),
    "core/test_core_hostile_text.py": ({"_exit"}, "os._exit: a process that dies at once"),
    "envs/envs_toys.py": ({"_exit"}, "os._exit: a process that dies at once"),
    "envs/test_envs_wrappers.py": ({"_tracker"}, "a tracker's first random number"),
    "flow/test_flow_maps.py": ({"_binomial"}, "exact weights, before they are folded into a kernel"),
    "flow/test_flow_sparse.py": ({"_runner"}, "counts the threads' work, which no result shows"),
    "runs/hostile.py": ({"_exit"}, "os._exit: a process that dies at once"),
    "runs/test_runs_infrastructure.py": ({"_process"}, "kills the fork server"),
    "segmentation/test_segmentation_hostile.py": ({"_cells"}, "the anchors, which no result of shapes alone shows"),
    "segmentation/test_segmentation_torchvision.py": ({"_dynamo"}, "torch._dynamo must not be loaded"),
    "sequences/test_synthetic_families.py": ({"_geometry", "_tiles"}, "the exact scene as one row alone sees it"),
    "sequences/test_synthetic_geometry.py": ({"_geometry", "_tiles"}, "the exact scene behind a rendered frame"),
    "trackers/adapters/test_adapter_orbslam3.py": (
        {"_process", "_program"},
        "kills the program behind it",
    ),
    "trackers/adapters/test_adapter_program_faults.py": (
        {"_command", "_exchange", "_process", "_program"},
        "kills the program, or looks for what it left on the disk",
    ),
    "tuning/test_storage.py": ({"_restore_optimizer"}, "the method in which Optuna unpickles"),
    "trackers/systems/test_method_page.py": ({"_flow"}, "the flow that the page promises is the one that runs"),
    "trackers/systems/test_systems.py": ({"_filters", "_masks"}, "what a system is composed of"),
    "trackers/systems/test_systems_bridging.py": ({"_filters", "_masks"}, "puts known masks in place of a network's"),
    "trackers/systems/test_systems_lost_flow.py": (
        {"_filters", "_flow"},
        "puts a flow that fails in its place",
    ),
}
"""Private names that a test may use, each file with its reason."""
CLOCK = {
    "core/fingerprint.py": "ages of files, which are stamped by that clock",
    "core/files.py": "ages of files, which are stamped by that clock",
}
"""Where the clock of the wall decides anything: it may jump, the monotonic one may not."""


def private_names(tree: ast.Module) -> set[str]:
    """Names with one leading underscore that a file takes from elsewhere."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            found |= {alias.name for alias in node.names} | set((node.module or "").split("."))
        elif isinstance(node, ast.Attribute) and not (isinstance(node.value, ast.Name) and node.value.id == "self"):
            found.add(node.attr)
    return {name for name in found if name.startswith("_") and not name.startswith("__")}


def sure(node: ast.expr, known: set[str]) -> bool:
    """Whether a loop over the expression surely runs."""
    match node:
        case ast.List(elts=items) | ast.Tuple(elts=items) | ast.Set(elts=items):
            return any(not isinstance(item, ast.Starred) or sure(item.value, known) for item in items)
        case ast.Dict(keys=keys):
            return bool(keys)
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name.isupper() or name in known
        case ast.Subscript(value=value):
            return sure(value, known)
        case ast.Call(func=ast.Name(id="range")):
            return True
        case ast.Call(func=ast.Name(id="enumerate" | "sorted" | "zip" | "list" | "tuple"), args=args, keywords=words):
            strict = any(word.arg == "strict" for word in words)
            return (any if strict else all)([sure(item, known) for item in args])
        case ast.Call(func=ast.Attribute(value=value, attr="items" | "values" | "keys")):
            return sure(value, known)
    return False


def asserts(statement: ast.stmt) -> bool:
    """Whether the statement itself is an assertion."""
    match statement:
        case ast.Assert():
            return True
        case ast.Expr(value=ast.Call(func=called)):
            return any(word in ast.unparse(called) for word in ("assert", "check", "raise", "fail"))
        case ast.With(items=items):
            return any(word in ast.unparse(item.context_expr) for item in items for word in ("raises", "warns"))
    return False


def certain(body: Sequence[ast.stmt], known: set[str]) -> bool:
    """Whether some assertion of the statements surely runs."""
    for statement in body:
        match statement:
            case ast.Assign(targets=[ast.Name(id=name)], value=value) if sure(value, known):
                known = known | {name}
            case _ if asserts(statement):
                return True
            case ast.With(body=inner) | ast.Try(body=inner) if certain(inner, known):
                return True
            case ast.For(iter=over, body=inner) if sure(over, known) and certain(inner, known):
                return True
            case ast.If(body=yes, orelse=no) if certain(yes, known) and certain(no, known):
                return True
    return False


def test_no_test_may_pass_without_an_assertion() -> None:
    assert len(FILES) > 100
    doubtful = []
    for file in FILES:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_") and node.name not in CERTAIN:
                if any(isinstance(inner, ast.Assert) for inner in ast.walk(node)) and not certain(node.body, set()):
                    doubtful.append(f"{file.relative_to(TESTS)}: {node.name}")
    assert doubtful == []


def test_the_checker_sees_what_it_is_for() -> None:
    empty = ast.parse("for row in rows():\n    assert row")
    assert not certain(empty.body, set())
    assert certain(ast.parse("rows = [1, 2]\nfor row in rows:\n    assert row").body, set())
    assert not certain(ast.parse("if found:\n    assert found").body, set())
    assert certain(ast.parse("if found:\n    assert found\nelse:\n    assert not found").body, set())


def test_private_names_are_asked_for_with_a_reason() -> None:
    files = [file for file in FILES if "fuzz" not in file.parts]  # it names the functions whose lines it counts
    found = {str(file.relative_to(TESTS)): private_names(ast.parse(file.read_text(encoding="utf-8"))) for file in files}
    beyond = {file: names - PRIVATE.get(file, (set(), ""))[0] for file, names in found.items()}
    assert {file: names for file, names in beyond.items() if names} == {}
    assert all(reason for _, reason in PRIVATE.values())
    assert not {file: names for file, (names, _) in PRIVATE.items() if names - found.get(file, set())}, "no longer used"


def test_every_exception_for_dead_code_has_a_reason() -> None:
    text = (TESTS.parent / ".ci" / "vulture_whitelist.py").read_text(encoding="utf-8")
    entries = [line for line in text.splitlines() if line and not line.startswith(("#", '"'))]
    assert len(entries) > 10
    assert [line for line in entries if "  # " not in line] == []


def test_nothing_waits_for_a_clock_that_may_jump() -> None:
    """Durations and deadlines come from ``time.monotonic``; ``time.time`` runs backwards when the clock is set."""
    root = TESTS.parent
    sources = [path for room in ("dynslam_bench", "envs", "tuning", "reports") for path in (root / room).rglob("*.py")]
    wall = re.compile(r"\btime\.time(_ns)?\(|import time as|from time import (.*, )?time\b")
    asked = {path for path in sources if wall.search(path.read_text())}
    assert len(sources) > 200
    assert {path.relative_to(root / "dynslam_bench").as_posix() for path in asked} == set(CLOCK)
