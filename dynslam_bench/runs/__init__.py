"""Runs: a child process that steps an environment; the run store; parallel execution.

`run_many` and `run_one` make runs, `RunStore` keeps them, `score` evaluates them under a protocol, `RunStore.frame` and
`load_frames` give them as pandas frames, `import_trajectory` puts trajectories from elsewhere beside them, and
`export_run` writes them in the formats of others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .exchange.export import Exported, export_run
    from .exchange.reading import read_trajectory
    from .identity import ResolvedRun, resolve
    from .many import RunEvent, run_many
    from .one import run_one
    from .spec import Limits, RunSpec
    from .storage.frame_table import load_frames
    from .storage.imported import import_trajectory
    from .storage.record import FAILED, MetricRecord, RunRecord
    from .storage.scoring import DEFAULT_PROTOCOL, score
    from .storage.store import RunStore

_HOMES = {
    "DEFAULT_PROTOCOL": "storage.scoring",
    "export_run": "exchange.export",
    "Exported": "exchange.export",
    "FAILED": "storage.record",
    "import_trajectory": "storage.imported",
    "Limits": "spec",
    "load_frames": "storage.frame_table",
    "MetricRecord": "storage.record",
    "read_trajectory": "exchange.reading",
    "resolve": "identity",
    "ResolvedRun": "identity",
    "run_many": "many",
    "run_one": "one",
    "RunEvent": "many",
    "RunRecord": "storage.record",
    "RunSpec": "spec",
    "RunStore": "storage.store",
    "score": "storage.scoring",
}

__all__ = [
    "DEFAULT_PROTOCOL",
    "FAILED",
    "Exported",
    "Limits",
    "MetricRecord",
    "ResolvedRun",
    "RunEvent",
    "RunRecord",
    "RunSpec",
    "RunStore",
    "export_run",
    "import_trajectory",
    "load_frames",
    "read_trajectory",
    "resolve",
    "run_many",
    "run_one",
    "score",
]


def __getattr__(name: str) -> Any:
    """Load what is asked for: the child, the store and the records need little, the environments much."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
