"""dynslam-bench: benchmark and tune visual SLAM in dynamic scenes through Gymnasium environments.

The public interface is `run`, `bench`, `tune`, `report`, `load`, `sequence`, see `dynslam_bench.api`,
and the packages `trackers` and `gate`:

    import dynslam_bench as db
    db.run("emfoa-oft", "synthetic/walking_xyz?scene=100", frames=(0, 60)).metrics

Importing this package loads none of its subpackages.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dynslam_bench import gate, trackers
    from dynslam_bench.api import bench, load, report, run, sequence, tune

__version__: str
__all__ = ["bench", "gate", "load", "report", "run", "sequence", "trackers", "tune"]

_PACKAGES = ("gate", "trackers")
"""Names of the public interface that are packages."""

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

    if name in _PACKAGES:
        return import_module(f"dynslam_bench.{name}")
    return getattr(import_module("dynslam_bench.api"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
