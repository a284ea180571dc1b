"""Documented modules that have moved: their old import paths work for one version, with a deprecation."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import sys
import types
from collections.abc import Sequence

from dynslam_bench.core.deprecated import warn_deprecated

CONTRACTS = "dynslam_bench.contracts"
GONE_IN = "0.2"
MOVED: dict[str, tuple[str, ...]] = {
    "dynslam_bench.culling.filter": ("dynslam_bench.contracts.filter",),
    "dynslam_bench.features.keypoints": ("dynslam_bench.contracts.features",),
    "dynslam_bench.flow.estimator": ("dynslam_bench.contracts.flow",),
    "dynslam_bench.flow.spec": ("dynslam_bench.contracts.flow", "dynslam_bench.flow.registry"),
    "dynslam_bench.segmentation.instances": ("dynslam_bench.contracts.segmenter",),
    "dynslam_bench.sequences.datasets": (
        "dynslam_bench.contracts.sequence",
        "dynslam_bench.sequences.catalogue",
    ),
    "dynslam_bench.sequences.frame": ("dynslam_bench.contracts.sequence", "dynslam_bench.sequences.view"),
    "dynslam_bench.slam.result": ("dynslam_bench.contracts.tracker",),
    "dynslam_bench.trackers.protocol": ("dynslam_bench.contracts.tracker",),
}
"""Old module: the modules in which its names are now, looked up in this order."""


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Makes an old module of the new ones' names, when somebody still imports it."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Answers for the moved modules only; asked after the real modules were looked for."""
        return importlib.machinery.ModuleSpec(fullname, self) if fullname in MOVED else None

    def exec_module(self, module: types.ModuleType) -> None:
        """Fill the old module."""
        homes = MOVED[module.__name__]
        room = CONTRACTS if homes[0].startswith(f"{CONTRACTS}.") else homes[0]
        warn_deprecated(f"'{module.__name__}' has moved", f"import from '{room}'", gone_in=GONE_IN)
        for home in reversed(homes):
            found = importlib.import_module(home)
            module.__dict__.update({name: value for name, value in vars(found).items() if not name.startswith("__")})


def install() -> None:
    """Let the old paths be imported; the second call changes nothing."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.append(_Finder())
