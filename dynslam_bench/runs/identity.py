"""What makes two runs the same run: everything that its result depends on, and nothing else."""

import json
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from dynslam_bench.contracts import Sequence, TrackerSpec
from dynslam_bench.contracts.checks import check_sensors
from dynslam_bench.core import PluginError, RunError, SettingsError, did_you_mean, raising
from dynslam_bench.core.fingerprint import (
    code_digest,
    contents_digest,
    distribution_of_module,
    has_package_changed,
    named_digests,
    plugin_digest,
    this_machine,
    versions,
)
from dynslam_bench.core.plugins import Registry, load_object
from dynslam_bench.core.records import digest
from dynslam_bench.core.settings import Settings, flatten, named
from dynslam_bench.core.version import release
from dynslam_bench.envs import Degradation
from dynslam_bench.envs.slam_env import check_frames, open_frames, preprocessing_of, resolve_device
from dynslam_bench.features.registry import FEATURES
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.flow.registry import FLOWS
from dynslam_bench.geometry import Camera
from dynslam_bench.runs.record import IDENTITY_SCHEME, StartMap
from dynslam_bench.runs.spec import MAP_SETTING, RunSpec
from dynslam_bench.segmentation.build_segmenter import SEGMENTERS, segmentation_source, weights_digest
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.sequences import DATASETS, PreprocessingSettings
from dynslam_bench.sequences.view import Part, part_of
from dynslam_bench.slam.map_files import MapFeatures, Sensors, read_map
from dynslam_bench.slam.settings import BackendSettings
from dynslam_bench.trackers.registry import TRACKERS, resolve_settings

CODE_PACKAGES = (
    *("core", "geometry", "contracts", "sequences", "features", "segmentation", "flow"),
    *("culling", "slam", "trackers", "envs"),
)
"""The packages whose source a trajectory may depend on."""
LIBRARIES = ("numpy", "scipy", "opencv", "torch", "numba")


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
        start_map: The map that it begins in; None for a run that begins without one.
        files: Those that the tracker's command names, in the identity by their content.
    """

    spec: RunSpec
    tracker: TrackerSpec
    settings: Settings
    sequence: Sequence
    device: str
    segmentation: str
    identity: dict[str, Any]
    start_map: StartMap | None = None
    files: tuple[Path, ...] = ()

    @cached_property
    def run_id(self) -> str:
        """Sixteen hexadecimal digits that stand for the identity."""
        return digest(self.identity, 16)


def resolve(spec: RunSpec) -> ResolvedRun:
    """Look up everything that a run names, before anything runs.

    Raises:
        DynslamError: Unknown tracker, setting, sequence, device or degradation; a sequence that is missing or has fewer
            than two frames; a semantic source that is not available; a tracker that needs a missing package, or
            depth that the sequence has not; a map to begin in that does not fit.
    """
    return Resolver()(spec)


class Resolver:
    """Looks up many runs as `resolve` does, but each sequence, tracker with settings, and device once.

    What they name must not change meanwhile.
    """

    def __init__(self) -> None:
        self._whole = lru_cache(maxsize=None)(open_frames)
        self._part = lru_cache(maxsize=None)(self._open_part)
        self._device = lru_cache(maxsize=None)(resolve_device)
        self._configured: dict[str, tuple[TrackerSpec, Settings, dict[str, Any]]] = {}
        self._code: dict[tuple[str, str], tuple[dict[str, Any], tuple[Path, ...]]] = {}

    def __call__(self, spec: RunSpec) -> ResolvedRun:
        """Look up a run; see `resolve`."""
        spec = spec.absolute()
        configuration = json.dumps([spec.tracker, spec.settings], sort_keys=True, default=str)
        if configuration not in self._configured:
            self._configured[configuration] = _configured(spec)
        tracker, settings, flat = self._configured[configuration]
        where = (spec.sequence, spec.data_root, spec.camera, preprocessing_of(settings))
        sequence, part, sequence_plugin = self._part(where, spec.frames_seen, spec.stride, spec.offset)
        check_sensors(tracker, sequence)
        strengths = set(Degradation.__dataclass_fields__) - {"seed"}
        for unknown in sorted(set(spec.degrade) - strengths):
            raise RunError(f"unknown degradation '{unknown}'", did_you_mean(unknown, strengths))
        Degradation(seed=0, **spec.degrade)  # checks the strengths
        device = self._device(spec.device)
        source = segmentation_source(settings, sequence)
        if (configuration, source) not in self._code:
            self._code[configuration, source] = _code_of(tracker, settings, source)
        code, files = self._code[configuration, source]
        start_map = start_map_of(settings, sequence.camera, tracker.sensors, code["weights"])
        identity = {
            "scheme": IDENTITY_SCHEME,
            "tracker": tracker.id,
            "tracker_version": tracker.version,
            **code,
            "settings": flat if start_map is None else flat | {MAP_SETTING: ""},  # its digest is among the weights
            "segmentation": source,
            "sequence": part.id,
            "content": part.content,
            "camera": part.camera,
            "frames": [part.start, part.stop],
            "offset": spec.offset,
            "stride": part.stride,
            "seed": spec.seed,
            "device": device,
            "threads": spec.threads,
            **({"cache": True} if spec.cache else {}),
            "realtime": spec.realtime,
            **({"machine": this_machine().model_dump()} if spec.realtime else {}),
            "drop_share": spec.drop_share,
            "degrade": {name: value for name, value in sorted(spec.degrade.items()) if value},
            **({"sequence_plugin": sequence_plugin} if sequence_plugin else {}),
        }
        return ResolvedRun(spec, tracker, settings, sequence, device, source, identity, start_map, files)

    def _open_part(
        self,
        where: tuple[str, str | None, str | None, PreprocessingSettings | None],
        frames: tuple[int, int | None] | None,
        stride: int,
        offset: int,
    ) -> tuple[Sequence, Part, str]:
        """Checked frames of a sequence, what part of it they are, and the digest of the plug-in that reads it."""
        name, data_root, camera, preprocessing = where
        whole = self._whole(name, data_root, camera, None, 1, preprocessing)
        sequence = open_frames(whole, None, None, frames, stride)
        check_frames(sequence)
        datasets = {plugin.spec.id: plugin.spec for plugin in DATASETS.all()}
        dataset = datasets.get(name.partition("/")[0])
        return sequence, part_of(sequence, offset), "" if dataset is None else plugin_digest(dataset.entry_point)


def _configured(spec: RunSpec) -> tuple[TrackerSpec, Settings, dict[str, Any]]:
    """The tracker of a run, its complete settings, and these by dotted name."""
    tracker = TRACKERS.get(spec.tracker)
    if missing := tracker.missing():
        raise RunError(f"tracker '{tracker.id}' needs a package that is not installed", "; ".join(missing))
    settings = resolve_settings(tracker, spec.settings)
    return tracker, settings, flatten(settings)


def _code_of(tracker: TrackerSpec, settings: Settings, source: str) -> tuple[dict[str, Any], tuple[Path, ...]]:
    """What of a run's identity says by which code, libraries, weights and files it is made; and the files."""
    with raising(PluginError, f"cannot read a file of tracker '{tracker.id}'"):
        files = tuple(map(Path, load_object(tracker.files)(settings))) if tracker.files else ()
        content = {"files": contents_digest(files)} if tracker.files else {}
    weights, group = named_digests(settings), getattr(settings, "segmentation", None)
    if source in ("embedded", "coco") and isinstance(group, SegmentationSettings):
        weights[source] = weights_digest(group.model_copy(update={"source": source}))
    installed = versions()  # another version of what computes with the run's data may give other bits
    top = tracker.entry_point.rpartition(":")[0].partition(".")[0]
    own = f"dynslam-bench {release()}"
    code = {
        "distribution": own if top == "dynslam_bench" else " ".join(distribution_of_module(top)).strip(),
        "source": source_fingerprint(tracker, settings, source),
        "requires": {module: distribution_of_module(module)[1] for module in sorted(tracker.requires)},
        "weights": weights,  # of every file that the settings name, or of the network in use where none is named
        **content,
        "libraries": {name: installed.get(name, "") for name in LIBRARIES},
    }
    return code, files


def source_fingerprint(tracker: TrackerSpec, settings: Settings | None = None, source: str = "") -> str:
    """Digest of the code that the tracker runs: this package's, the tracker's own, and that of plug-ins it names.

    Args:
        tracker: The tracker.
        settings: Its settings; the plug-ins that they name count with their code.
        source: Where its masks come from; ``plugin:ID`` counts with its code.

    Raises:
        PluginError: A plug-in is unknown, or its code cannot be read.
    """
    registries: dict[str, Registry[Any]] = {"features": FEATURES, "flow": FLOWS}
    plugins = {}
    for name, (kind, value) in sorted(named(settings).items() if settings is not None else ()):
        if kind in registries:
            plugins[name] = plugin_digest(registries[kind].get(value).entry_point)
    prefix, _, segmenter = source.partition(":")
    if prefix == "plugin":
        plugins["segmentation.source"] = plugin_digest(SEGMENTERS.get(segmenter).entry_point)
    return digest([code_digest(tracker.entry_point, CODE_PACKAGES), plugins])


def check_unchanged(run: ResolvedRun, *, begun: bool = False) -> None:
    """What a run is made of is what was looked up for it: data, code, files, weights, map.

    Args:
        run: The run.
        begun: Whether it was begun: what a program's command names may be its output then.

    Raises:
        RunError: Something has changed since.
        DynslamError: Something cannot be read any more.
    """
    if has_package_changed(CODE_PACKAGES):
        raise RunError("the code of dynslam-bench has changed since this process began", "start it again")
    before, now = run.identity, resolve(run.spec).identity
    with raising(PluginError, f"cannot read a file of tracker '{run.tracker.id}'"):
        now |= {"files": contents_digest(run.files) if run.files and not begun else before.get("files")}
    now["weights"] = {name: now["weights"].get(name) if value else value for name, value in before["weights"].items()}
    changed = [name for name in before if now.get(name) != before[name]]
    if changed:
        words = {"source": f"the code of tracker '{run.tracker.id}'", "content": f"sequence '{run.sequence.id}'"}
        words |= {"files": f"the program of tracker '{run.tracker.id}'", "weights": "a file that the settings name"}
        what = ", ".join(words.get(name, name) for name in changed)
        hint = "the run is not stored; ask again, and let no tracker write files beside its code or data"
        raise RunError(f"{what} has changed since the run was asked for", hint)


def start_map_of(settings: Settings, camera: Camera, sensors: Sensors, digests: dict[str, str]) -> StartMap | None:
    """The map that settings name; None where they name none.

    Args:
        settings: A tracker's complete settings.
        camera: Of the sequence, as the tracker sees it.
        sensors: Of the tracker.
        digests: Of the files that the settings name, by the setting's name.

    Raises:
        SettingsError: The tracker has features of its own; the file is no map, or one of another camera, other features
            or another sensor.
    """
    backend, features = getattr(settings, "backend", None), getattr(settings, "features", None)
    if not isinstance(backend, BackendSettings) or not backend.map.file:
        return None
    if not isinstance(features, FeatureSettings):
        raise SettingsError(f"'{MAP_SETTING}' is set, and the tracker's features are none that maps are made of")
    path = Path(backend.map.file).expanduser()
    saved = read_map(path)
    made_of = MapFeatures(extractor=features.extractor, levels=features.levels, scale_factor=features.scale_factor)
    saved.check(camera, made_of, sensors, str(path))
    return StartMap(
        digest=digests[MAP_SETTING],
        file=str(path),
        made_by=saved.header.made_by,
        keyframes=len(saved.arrays["kf_id"]),
        points=len(saved.arrays["id"]),
        localisation_only=backend.map.localisation_only,
    )
