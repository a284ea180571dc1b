"""Runs: a child process that steps an environment; the run store; parallel execution.

`run_many` and `run_one` make runs, `RunStore` keeps them, `score` evaluates them under a protocol, and
`import_trajectory` puts trajectories from elsewhere beside them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .bench import RunEvent, run_many
    from .execute import run_one
    from .identity import ResolvedRun, resolve
    from .imports import import_trajectory
    from .record import FAILED, MetricRecord, RunRecord
    from .scoring import DEFAULT_PROTOCOL, score
    from .spec import Limits, RunSpec
    from .store import RunStore

_HOMES = {
    "FAILED": "record", "DEFAULT_PROTOCOL": "scoring", "Limits": "spec", "MetricRecord": "record",
    "ResolvedRun": "identity", "RunEvent": "bench", "RunRecord": "record", "RunSpec": "spec", "RunStore": "store",
    "import_trajectory": "imports", "resolve": "identity", "run_many": "bench", "run_one": "execute",
    "score": "scoring",
}  # fmt: skip

__all__ = [
    "DEFAULT_PROTOCOL",
    "FAILED",
    "Limits",
    "MetricRecord",
    "ResolvedRun",
    "RunEvent",
    "RunRecord",
    "RunSpec",
    "RunStore",
    "import_trajectory",
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
