"""The gate: whether a change of a SLAM system made its errors smaller or larger, decided by paired runs.

`init` writes ``gate.toml``, the question. `record` runs what the working tree holds and writes the
baseline file, which is committed. `check` judges the working tree against it, `compare` one revision
against another one. The decision is in `evaluation.gate`.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dynslam_bench.gate.baseline import Baseline
    from dynslam_bench.gate.checking import check, compare, init, record
    from dynslam_bench.gate.config import GateConfig, load_gate
    from dynslam_bench.gate.result import GateResult

_DEFINED_IN = {
    "Baseline": "baseline",
    "check": "checking",
    "compare": "checking",
    "GateConfig": "config",
    "GateResult": "result",
    "init": "checking",
    "load_gate": "config",
    "record": "checking",
}

__all__ = [
    "Baseline",
    "GateConfig",
    "GateResult",
    "check",
    "compare",
    "init",
    "load_gate",
    "record",
]


def __getattr__(name: str) -> Any:
    """Load what is asked for: pytest imports this package whenever it starts."""
    if name not in _DEFINED_IN:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_DEFINED_IN[name]}"), name)
