"""How many commits change the run ids of a system: the import closure against whole packages.

    python tests/benchmarks/identity_commits.py --last 300 --upto 62446da7

Of each commit the sources are read from git; nothing is run. Edges that were cut later (`CUT`) are
left out in older commits, too, so that the figure says what today's structure would have cost. Of
the 300 commits up to 62446da7, 62 change `orb-slam2` and 39 `never-move`; with the imports as these
commits have them it is 98 and 43. What `never-move` gains is the import of `runs.process.child` by
`runs.loop` alone.
"""

import argparse
import subprocess
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from dynslam_bench.core.module_graph import PACKAGE, ModuleCode, ModuleGraph, read_module
from dynslam_bench.runs.own_code import modules_of_run

CHECKOUT = Path(__file__).resolve().parents[2]
OLD_PACKAGES = (
    *("core", "geometry", "contracts", "sequences", "features", "segmentation", "flow"),
    *("culling", "slam", "trackers", "envs"),
)
"""What every run id depended on before: whole packages."""
SYSTEMS = {
    "orb-slam2": ("trackers.systems.composition", "features.orb", "sequences.synthetic.sequence"),
    "never-move": ("trackers.adapters.controls", "sequences.synthetic.sequence"),
}
"""What a system's runs on a rendered scene begin with."""
CUT = {
    ("flow.registry", "flow"),
    ("segmentation.networks.checkpoints", "sequences"),
    ("trackers.systems.composition", "segmentation.build_segmenter"),
    ("trackers.systems.composition", "segmentation.schedule"),
    ("trackers.systems.composition", "flow"),
    ("slam.pipeline", "culling.ego_motion"),
    ("runs.loop", "runs.process.child"),
}
"""Imports that were taken out when ids began to follow imports: module, and what it imported."""


def git(*words: str) -> bytes:
    """The output of a git command in this checkout."""
    return subprocess.run(["git", *words], cwd=CHECKOUT, check=True, capture_output=True).stdout


def sources(commit: str) -> dict[str, str]:
    """The git object of each module's source at a commit, by the module's name."""
    listed = git(
        "ls-tree", "-r", commit, "--", "dynslam_bench", "envs", "tuning", "reports"
    ).decode()
    objects = {}
    for line in listed.splitlines():
        about, _, path = line.partition("\t")
        if not path.endswith(".py"):
            continue
        parts = PurePosixPath(path).with_suffix("").parts
        parts = parts if parts[0] == PACKAGE else (PACKAGE, *parts)
        objects[".".join(parts).removesuffix(".__init__")] = about.split()[2]
    return objects


class History:
    """Graphs of commits; each source is parsed once."""

    def __init__(self) -> None:
        self._codes: dict[tuple[str, str], ModuleCode] = {}

    def graph(self, commit: str) -> ModuleGraph:
        """The modules of a commit without the imports that were cut later."""
        modules = {}
        for name, blob in sources(commit).items():
            if (name, blob) not in self._codes:
                self._codes[name, blob] = read_module(name, git("cat-file", "blob", blob))
            code = self._codes[name, blob]
            kept = [reference for reference in code.imports if not is_cut(name, reference)]
            modules[name] = ModuleCode(code.digest, kept, code.names)
        return ModuleGraph(modules)


def is_cut(module: str, reference: tuple[str, str]) -> bool:
    """Whether an import was taken out later."""
    imported = ".".join(filter(None, reference))
    return any(
        module == f"{PACKAGE}.{source}" and f"{imported}.".startswith(f"{PACKAGE}.{target}.")
        for source, target in CUT
    )


def digest_of_packages(graph: ModuleGraph, packages: Iterable[str]) -> str:
    """What ids depended on before."""
    starts = tuple(f"{PACKAGE}.{package}" for package in packages)
    return str(
        sorted(
            (name, code.digest) for name, code in graph.modules.items() if name.startswith(starts)
        )
    )


def main() -> None:
    """Print how many of the last commits change the id of each system."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--last", type=int, default=300)
    parser.add_argument("--upto", default="HEAD")
    arguments = parser.parse_args()
    commits = (
        git("rev-list", "--first-parent", f"--max-count={arguments.last + 1}", arguments.upto)
        .decode()
        .split()
    )
    history = History()
    changes = dict.fromkeys(["whole packages", *SYSTEMS], 0)
    counted: dict[str, int] = {}
    before: dict[str, str] = {}
    for commit in reversed(commits):
        graph = history.graph(commit)
        now = {"whole packages": digest_of_packages(graph, OLD_PACKAGES)}
        for system, begins in SYSTEMS.items():
            modules = modules_of_run(graph, [f"{PACKAGE}.{name}" for name in begins])
            now[system] = graph.code_digest(modules)
            counted[system] = len(modules)
        for name, digest in now.items():
            changes[name] += before.get(name, digest) != digest
        before = now
    for name, count in changes.items():
        print(
            f"{name}: {count} of {len(commits) - 1} commits",
            f"({counted[name]} modules)" if name in counted else "",
        )


if __name__ == "__main__":
    main()
