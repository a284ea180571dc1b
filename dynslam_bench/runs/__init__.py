"""Runs: a child process that steps an environment; the run store; parallel execution.

`run_many` and `run_one` make runs, `RunStore` keeps them, `score` evaluates them under a protocol,
`RunStore.frame` and `load_frames` give them as pandas frames, `import_trajectory` puts trajectories
from elsewhere beside them, and `export_run` writes them in the formats of others.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dynslam_bench.runs.copying import merge
    from dynslam_bench.runs.exchange.formats import read_trajectory
    from dynslam_bench.runs.exchange.transfer import Exported, export_run, import_trajectory
    from dynslam_bench.runs.frames import load_frames
    from dynslam_bench.runs.identity import ResolvedRun, resolve
    from dynslam_bench.runs.listing import list_runs, rescore
    from dynslam_bench.runs.many import PlannedRuns, RunEvent, requested_files, run_many
    from dynslam_bench.runs.record import FAILED, MetricRecord, RunRecord
    from dynslam_bench.runs.rows import make_run_row, part_words
    from dynslam_bench.runs.running import run_one
    from dynslam_bench.runs.spec import Limits, RunSpec
    from dynslam_bench.runs.store import DEFAULT_PROTOCOL, RunStore, open_store, score

_DEFINED_IN = {
    "DEFAULT_PROTOCOL": "store",
    "export_run": "exchange.transfer",
    "Exported": "exchange.transfer",
    "FAILED": "record",
    "import_trajectory": "exchange.transfer",
    "Limits": "spec",
    "list_runs": "listing",
    "load_frames": "frames",
    "merge": "copying",
    "MetricRecord": "record",
    "open_store": "store",
    "part_words": "rows",
    "requested_files": "many",
    "read_trajectory": "exchange.formats",
    "rescore": "listing",
    "resolve": "identity",
    "PlannedRuns": "many",
    "ResolvedRun": "identity",
    "run_many": "many",
    "run_one": "running",
    "make_run_row": "rows",
    "score": "store",
    "RunEvent": "many",
    "RunRecord": "record",
    "RunSpec": "spec",
    "RunStore": "store",
}

__all__ = [
    "DEFAULT_PROTOCOL",
    "FAILED",
    "Exported",
    "Limits",
    "MetricRecord",
    "PlannedRuns",
    "ResolvedRun",
    "RunEvent",
    "RunRecord",
    "RunSpec",
    "RunStore",
    "export_run",
    "import_trajectory",
    "list_runs",
    "load_frames",
    "make_run_row",
    "merge",
    "open_store",
    "part_words",
    "read_trajectory",
    "requested_files",
    "rescore",
    "resolve",
    "run_many",
    "run_one",
    "score",
]


def __getattr__(name: str) -> Any:
    """Load what is asked for: the child, the store and the records need little, the environments much."""
    if name not in _DEFINED_IN:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_DEFINED_IN[name]}"), name)
