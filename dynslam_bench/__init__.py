"""dynslam-bench: benchmark and tune visual SLAM in dynamic scenes through Gymnasium environments.

The rooms: `core`, `geometry`, `contracts`, `sequences`, `evaluation`, `features`, `segmentation`, `flow`, `culling`,
`slam`, `trackers`, `envs`, `runs`, `suites`, `reports`, `testing`, `tuning`, `cli`. Importing this package loads none
of them.
"""

from __future__ import annotations

from pathlib import Path

__version__: str

_checkout = Path(__file__).resolve().parent.parent
if (_checkout / "pyproject.toml").is_file() and (_checkout / "envs" / "__init__.py").is_file():
    # In a bare checkout `envs/`, `tuning/` and `reports/` lie beside this package instead of inside it.
    __path__.append(str(_checkout))
del _checkout


def __getattr__(name: str) -> str:
    """``__version__``, looked up when somebody asks for it: that takes longer than all else here."""
    if name == "__version__":
        from dynslam_bench.core.version import version

        return version()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
