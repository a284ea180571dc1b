"""dynslam-bench: benchmark and tune visual SLAM in dynamic scenes through Gymnasium environments.

The public interface is `run`, `bench`, `tune`, `report`, `load`, `sequence` and `trackers`, see
`dynslam_bench.api`:

    import dynslam_bench as db
    db.run("emfoa-oft", "synthetic/walking_xyz?scene=100", frames=(0, 60)).metrics

Importing this package loads none of its subpackages.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dynslam_bench import trackers
    from dynslam_bench.api import bench, load, report, run, sequence, tune

__version__: str
__all__ = ["bench", "load", "report", "run", "sequence", "trackers", "tune"]

_checkout = Path(__file__).resolve().parent.parent
if (_checkout / "pyproject.toml").is_file() and (_checkout / "envs" / "__init__.py").is_file():
    # In a bare checkout `envs/`, `tuning/` and `reports/` lie beside this package instead of inside
    # it.
    __path__.append(str(_checkout))
del _checkout


def __getattr__(name: str) -> Any:
    """The names of the public interface and ``__version__``, loaded on first use."""
    if name == "__version__":
        from dynslam_bench.core.version import version

        return version()
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return (
        import_module("dynslam_bench.trackers")
        if name == "trackers"
        else getattr(import_module("dynslam_bench.api"), name)
    )


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
