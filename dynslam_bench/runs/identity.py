"""What makes two runs the same run: everything that its result depends on, and nothing else."""

from __future__ import annotations

import hashlib
import sys
from dataclasses import asdict, dataclass
from functools import cache, lru_cache
from importlib.metadata import packages_distributions, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import dynslam_bench
from dynslam_bench.core.errors import RunError, SequenceError
from dynslam_bench.core.plugins import load_object
from dynslam_bench.core.records import digest
from dynslam_bench.core.settings import Settings, flatten
from dynslam_bench.envs.degrade_frames import Degradation
from dynslam_bench.envs.device import resolve_device
from dynslam_bench.envs.source import open_frames, preprocessing_of
from dynslam_bench.segmentation.availability import segmentation_source
from dynslam_bench.sequences.frame import Sequence
from dynslam_bench.trackers.protocol import TrackerSpec
from dynslam_bench.trackers.registry import TRACKERS, resolve_settings

from .machine import versions
from .spec import RunSpec

_ROOMS = ("core", "geometry", "sequences", "features", "segmentation", "flow", "culling", "slam", "trackers", "envs")
"""The rooms whose source a trajectory may depend on."""
_MOST_FILES = 500


@dataclass(frozen=True, eq=False)
class ResolvedRun:
    """A run whose every name was looked up.

    Attributes:
        spec: The request, with absolute paths.
        tracker: The tracker's spec.
        settings: Its complete settings.
        sequence: The opened sequence, cut to the frames asked for.
        device: ``cpu`` or ``cuda:N``.
        segmentation: Where the masks come from; empty for trackers without a semantic stage.
        identity: What the run's id is a digest of.
    """

    spec: RunSpec
    tracker: TrackerSpec
    settings: Settings
    sequence: Sequence
    device: str
    segmentation: str
    identity: dict[str, Any]

    @property
    def run_id(self) -> str:
        """Sixteen hexadecimal digits that stand for the identity."""
        return digest(self.identity, 16)


def resolve(spec: RunSpec) -> ResolvedRun:
    """Look up everything that a run names, before anything runs.

    Raises:
        DynslamError: Unknown tracker, setting, sequence, device or degradation; a sequence that is missing or has fewer
            than two frames; a semantic source that is not available; a tracker that needs a missing package.
    """
    spec = spec.absolute()
    tracker = TRACKERS.get(spec.tracker)
    missing = tracker.missing()
    if missing:
        raise RunError(f"tracker '{tracker.id}' needs a package that is not installed", "; ".join(missing))
    settings = resolve_settings(tracker, spec.settings)
    sequence = open_frames(
        spec.sequence, spec.data_root, spec.camera, spec.frames, spec.stride, preprocessing_of(settings)
    )
    if len(sequence) < 2:
        raise SequenceError(f"'{sequence.id}' has {len(sequence)} frames here, a run needs 2 or more")
    _check_degradation(spec.degrade)
    device = resolve_device(spec.device)
    source = segmentation_source(settings, sequence)
    known = versions()
    identity = {
        "tracker": tracker.id,
        "tracker_version": tracker.version,
        "distribution": distribution_of(tracker),
        "source": source_fingerprint(tracker),
        "settings": flatten(settings),
        "segmentation": source,
        "weights": weights_of(settings, source),
        **files_of(tracker, settings),
        "sequence": sequence.id,
        "content": sequence.digest(),
        "camera": asdict(sequence.camera),
        "frames": spec.frames,
        "stride": spec.stride,
        "seed": spec.seed,
        "device": device,
        "threads": spec.threads,
        **({"cache": True} if spec.cache else {}),
        "realtime": spec.realtime,
        "drop_share": spec.drop_share,
        "degrade": {name: value for name, value in sorted(spec.degrade.items()) if value},
        "opencv": known.get("opencv", ""),
        "torch": known.get("torch", ""),
    }
    return ResolvedRun(spec, tracker, settings, sequence, device, source, identity)


def distribution_of(tracker: TrackerSpec) -> str:
    """Name and version of the distribution that the tracker's code comes from, e.g. ``dynslam-bench 0.1.0``."""
    top = tracker.entry_point.rpartition(":")[0].partition(".")[0]
    if top == "dynslam_bench":
        return f"dynslam-bench {dynslam_bench.__version__}"
    names = _distributions().get(top, [])
    return f"{names[0]} {version(names[0])}" if names else ""


def source_fingerprint(tracker: TrackerSpec) -> str:
    """Digest of the source that the tracker runs: this package's, and the plug-in's own.

    A plug-in in a file counts with all Python files of its folder, one in a package with all of the package's.
    """
    module = tracker.entry_point.rpartition(":")[0]
    parts = [_package_fingerprint()]
    if module.endswith(".py"):
        parts.append(_digest_files(sorted(Path(module).expanduser().resolve().parent.glob("*.py"))))
    elif module.partition(".")[0] != "dynslam_bench":
        parts.append(_digest_files(_module_files(module)))
    return digest(parts)


def weights_of(settings: Settings, source: str) -> dict[str, str]:
    """Digest of every file that the settings name, by the setting's name; of the embedded network where it is used."""
    found = {}
    for name, value in flatten(settings).items():
        path = _named_path(value)
        if path is not None:
            found[name] = _digest_path(path)
    if source == "embedded":
        from dynslam_bench.segmentation.checkpoints import embedded_weights

        weights = embedded_weights()
        if weights is not None:
            found["embedded"] = _digest_path(Path(str(weights)))
    return found


def files_of(tracker: TrackerSpec, settings: Settings) -> dict[str, list[str]]:
    """``files``: digests of what the tracker's spec says decides its results beside its settings; else nothing."""
    if not tracker.files:
        return {}
    return {"files": [_digest_path(path) for path in load_object(tracker.files)(settings)]}


def _check_degradation(strengths: dict[str, float]) -> None:
    known = set(Degradation.__dataclass_fields__) - {"seed"}
    unknown = sorted(set(strengths) - known)
    if unknown:
        raise RunError(f"unknown degradation '{unknown[0]}'", "known: " + ", ".join(sorted(known)))
    Degradation(seed=0, **strengths)


@cache
def _package_fingerprint() -> str:
    roots = [Path(folder) / room for folder in dynslam_bench.__path__ for room in _ROOMS]
    return _digest_files([file for root in roots for file in sorted(root.rglob("*.py"))])


@cache
def _distributions() -> dict[str, list[str]]:
    return {top: list(names) for top, names in packages_distributions().items()}


def _module_files(module: str) -> list[Path]:
    """Source files of a module's top-level package, found without importing it if it is not imported yet."""
    top = module.partition(".")[0]
    loaded = sys.modules.get(top)
    spec = getattr(loaded, "__spec__", None) or find_spec(top)
    if spec is None or spec.origin is None:
        return []
    origin = Path(spec.origin)
    return sorted(origin.parent.rglob("*.py")) if origin.name == "__init__.py" else [origin]


def _named_path(value: object) -> Path | None:
    if not isinstance(value, str) or not value:
        return None
    for text in (value, value.partition(":")[2]):
        path = Path(text).expanduser() if text else None
        if path is not None and len(text) < 1000 and (path.is_file() or (path.is_dir() and text != ".")):
            return path
    return None


def _digest_files(files: list[Path]) -> str:
    whole = hashlib.sha256()
    for file in files[:_MOST_FILES]:
        whole.update(f"{file.name}\0{len(files)}\0".encode() + file.read_bytes())
    return whole.hexdigest()[:16]


def _digest_path(path: Path) -> str:
    if path.is_file():
        stat = path.stat()
        return _digest_file(str(path), stat.st_size, stat.st_mtime_ns)
    listing = [(str(file.relative_to(path)), file.stat().st_size) for file in sorted(path.rglob("*")) if file.is_file()]
    return digest(listing)


@lru_cache(maxsize=256)
def _digest_file(path: str, size: int, mtime_ns: int) -> str:
    whole = hashlib.sha256()
    with Path(path).open("rb") as file:
        while block := file.read(1 << 20):
            whole.update(block)
    return whole.hexdigest()[:16]
