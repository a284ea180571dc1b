"""Identity of a run: what was asked for, and what was read for it.

A run's id has twelve digits of what was asked for and eight of what was read. A stored run is taken
again while all that was read for it is unchanged.
"""

import json
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from dynslam_bench.contracts import Sequence, TrackerSpec
from dynslam_bench.contracts.checks import check_sensors
from dynslam_bench.core import PluginError, RunError, SettingsError, did_you_mean, translate_errors
from dynslam_bench.core.fingerprint import (
    contents_digest,
    distribution_of_module,
    named_digests,
    this_machine,
)
from dynslam_bench.core.libraries import library_identity, search_path
from dynslam_bench.core.module_graph import (
    ModuleGraph,
    check_byte_code,
    module_graph,
    read_module_graph,
)
from dynslam_bench.core.plugins import load_object
from dynslam_bench.core.reads import BaseFolders, ImportPath
from dynslam_bench.core.settings import Settings, flatten
from dynslam_bench.core.version import release
from dynslam_bench.envs.slam_env import check_frames, open_frames, preprocessing_of, resolve_device
from dynslam_bench.envs.wrappers import Degradation
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.geometry import Camera
from dynslam_bench.runs.own_code import (
    base_folders_of,
    components_of_run,
    is_file,
    is_outside_package,
    module_of,
    modules_by_component,
    portable_name,
)
from dynslam_bench.runs.record import (
    ASKED_DIGITS,
    IDENTITY_SCHEME,
    StartMap,
    digest_of_reads,
    digest_of_request,
)
from dynslam_bench.runs.spec import MAP_SETTING, RunSpec
from dynslam_bench.segmentation.build_segmenter import segmentation_source, weights_digest
from dynslam_bench.segmentation.networks.checkpoints import CHECKPOINTS
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.sequences import PreprocessingSettings
from dynslam_bench.sequences.view import SequencePart, reader_of, sequence_part_of
from dynslam_bench.slam.map_files import MapFeatures, Sensors, read_map
from dynslam_bench.slam.settings import BackendSettings
from dynslam_bench.trackers.registry import TRACKERS, resolve_settings

LIBRARIES = {
    "numpy": "numpy",
    "scipy": "scipy",
    "opencv": "cv2",
    "torch": "torch",
    "numba": "numba",
}
"""The modules that compute with a run's data, by the name that tables give them."""


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
        identity: What is asked for, and what is known beforehand of what the run will read, as it
            reads after it was stored.
        read_digest: The last eight digits of its id: what is known beforehand of what it will read.
        base_folders: The folders in which names of files begin that plug-ins and programs read.
        has_plugins_or_programs: Whether they take part; what they read is known only after the run.
        start_map: The map that it begins in; None for a run that begins without one.
        files: Files that the tracker's command names; their content is part of the identity.
    """

    spec: RunSpec
    tracker: TrackerSpec
    settings: Settings
    sequence: Sequence
    device: str
    segmentation: str
    identity: dict[str, Any]
    read_digest: str
    base_folders: BaseFolders
    has_plugins_or_programs: bool = False
    start_map: StartMap | None = None
    files: tuple[Path, ...] = ()

    @cached_property
    def request_digest(self) -> str:
        """The first twelve digits of its id: what is asked for."""
        return self.run_id[:ASKED_DIGITS]

    @cached_property
    def run_id(self) -> str:
        """Id of the run; that of a run with plug-ins or programs changes when it is known what they read."""
        return digest_of_request(self.identity) + self.read_digest

    @cached_property
    def plugin_packages(self) -> list[str]:
        """The top-level names of the installed modules that take part."""
        parts = [
            part
            for part in self.identity["parts"]
            if is_outside_package(part) and not is_file(part)
        ]
        return sorted({module_of(part).partition(".")[0] for part in parts})

    @property
    def distribution(self) -> str:
        """Name and version of the distribution that the tracker comes from."""
        top = self.tracker.entry_point.rpartition(":")[0].partition(".")[0]
        if top == "dynslam_bench":
            return f"dynslam-bench {release()}"
        return " ".join(distribution_of_module(top)).strip()


class _Configuration(NamedTuple):
    """A tracker with its settings.

    Attributes:
        key: Name and overrides as text: equal texts stand for equal configurations.
        tracker: The tracker's spec.
        settings: Its complete settings.
        flat: These by dotted name.
    """

    key: str
    tracker: TrackerSpec
    settings: Settings
    flat: dict[str, Any]


def resolve(spec: RunSpec) -> ResolvedRun:
    """Look up everything that a run names, before anything runs.

    Raises:
        DynslamError: Unknown tracker, setting, sequence, device or degradation; a sequence that is
            missing or has fewer than two frames; a semantic source that is not available; a tracker
            that needs a missing package, or depth that the sequence has not; a map to begin in that
            does not fit.
    """
    return Resolver()(spec)


_LOOKED_UP = (
    "tracker",
    "sequence",
    "settings",
    "frames",
    "offset",
    "stride",
    "device",
    "threads",
    "cache",
    "realtime",
    "drop_share",
    "degrade",
    "data_root",
    "camera",
)
"""The fields of a `RunSpec` that are looked up. Runs that are equal in these differ by their seed at most."""


class Resolver:
    """Looks up many runs, each sequence, tracker with settings, and device once; see `resolve`.

    What they name must not change meanwhile.
    """

    def __init__(self) -> None:
        self._runs: dict[str, ResolvedRun] = {}
        self._whole = lru_cache(maxsize=None)(open_frames)
        self._opened_part = lru_cache(maxsize=None)(self._open_part)
        self._device = lru_cache(maxsize=None)(resolve_device)
        self._libraries = lru_cache(maxsize=None)(libraries)
        self._configurations: dict[str, _Configuration] = {}
        self._files: dict[tuple[str, str], tuple[dict[str, Any], tuple[Path, ...]]] = {}
        self._components: dict[tuple[str, str, str, bool], tuple[list[str], BaseFolders]] = {}

    def __call__(self, spec: RunSpec) -> ResolvedRun:
        """Look up everything that decides a run's result, and name it by digests.

        Raises:
            DynslamError: A name of the request is not known, or a setting does not fit, see
                `resolve`.
        """
        names = [getattr(spec, name) for name in _LOOKED_UP]
        key = json.dumps(names, sort_keys=True, default=str)
        run = self._runs.get(key)
        if run is None:
            run = self._look_up(spec.absolute())
            self._runs[key] = run
        # it may have another seed, and be asked for other pictures
        absolute = {name: getattr(run.spec, name) for name in _LOOKED_UP}
        return replace(
            run,
            spec=spec.model_copy(update=absolute),
            identity=run.identity | {"seed": spec.seed},
        )

    def _look_up(self, spec: RunSpec) -> ResolvedRun:
        """Look up a run of absolute names; see `__call__`.

        The identity has two parts. `asked` is the request: tracker, settings, frames, seed, device.
        `read` is what is known before the run of what it will read: code, libraries, weights, the
        sequence's content. The run's id is made of both (`record.run_id_of`); what a plug-in opens is
        added after its run.

        Raises:
            DynslamError: A name of the request is not known, or a setting does not fit, see
                `resolve`.
        """
        configured = self._configuration(spec)
        tracker = configured.tracker
        settings = configured.settings

        # open the sequence, cut to the frames asked for; refuse what the tracker cannot use
        preprocessing = preprocessing_of(settings)
        if preprocessing is not None and not preprocessing.changes_images:
            preprocessing = None  # trackers with and without such settings share the frames
        where = (spec.sequence, spec.data_root, spec.camera, preprocessing)
        sequence, part = self._opened_part(where, spec.frames_seen, spec.stride, spec.offset)
        check_sensors(tracker, sequence)
        check_degradation(spec.degrade)
        device = self._device(spec.device)

        # weights, the files of the tracker's program, and the map to begin in
        source = segmentation_source(settings, sequence)
        named, files = self._named_files(configured, source)
        start_map = start_map_of(settings, sequence.camera, tracker.sensors, named["weights"])

        asked = _asked(spec, configured, part, device, start_map)
        changes_frames = bool(asked["degrade"]) or spec.realtime or bool(spec.drop_share)
        parts, base_folders = self._named_components(
            configured, source, sequence, changes_frames=changes_frames
        )

        # what it will read, as far as that is known beforehand
        read = {
            "tracker_version": tracker.version,
            "parts": parts,
            "source": source_digests(parts),
            "requires": {module: library_identity(module) for module in sorted(tracker.requires)},
            "libraries": self._libraries(),
            **named,
            "segmentation": source,
            "content": part.content,
            "camera": part.camera,
        }
        if spec.realtime:  # which frames are dropped depends on the machine's speed
            read["machine"] = this_machine().model_dump()
        identity = json.loads(json.dumps(asked | read, default=str))
        return ResolvedRun(
            spec=spec,
            tracker=tracker,
            settings=settings,
            sequence=sequence,
            device=device,
            segmentation=source,
            identity=identity,
            read_digest=digest_of_reads(identity),
            base_folders=base_folders,
            has_plugins_or_programs=any(map(is_outside_package, parts)) or bool(tracker.files),
            start_map=start_map,
            files=files,
        )

    def _configuration(self, spec: RunSpec) -> _Configuration:
        """The tracker of a run with its settings, looked up once."""
        key = json.dumps([spec.tracker, spec.settings], sort_keys=True, default=str)
        if key not in self._configurations:
            self._configurations[key] = _configure(spec, key)
        return self._configurations[key]

    def _named_files(
        self, configured: _Configuration, source: str
    ) -> tuple[dict[str, Any], tuple[Path, ...]]:
        """Look up the result of `_files_of` once for a tracker with its settings and a source of masks."""
        key = (configured.key, source)
        if key not in self._files:
            self._files[key] = _files_of(configured.tracker, configured.settings, source)
        return self._files[key]

    def _named_components(
        self, configured: _Configuration, source: str, sequence: Sequence, *, changes_frames: bool
    ) -> tuple[list[str], BaseFolders]:
        """Components of a run by the names of its identity, and the folders in which the names of files begin.

        Looked up once for a tracker with its settings, a source of masks and a kind of sequence;
        see `components_of_run`.
        """
        reader = reader_of(sequence)
        key = (configured.key, source, reader, changes_frames)
        if key not in self._components:
            entry_points = components_of_run(
                configured.tracker,
                configured.settings,
                source,
                reader,
                changes_frames=changes_frames,
            )
            base_folders = base_folders_of(configured.tracker, entry_points)
            parts = sorted(portable_name(entry, base_folders) for entry in entry_points)
            self._components[key] = (parts, base_folders)
        return self._components[key]

    def _open_part(
        self,
        where: tuple[str, str | None, str | None, PreprocessingSettings | None],
        frames: tuple[int, int | None] | None,
        stride: int,
        offset: int,
    ) -> tuple[Sequence, SequencePart]:
        """Checked frames of a sequence, and what part of it they are."""
        name, data_root, camera, preprocessing = where
        whole = self._whole(name, data_root, camera, None, 1, preprocessing)
        sequence = open_frames(whole, None, None, frames, stride)
        check_frames(sequence)
        return sequence, sequence_part_of(sequence, offset)


def check_degradation(strengths: Mapping[str, float]) -> None:
    """Refuse degradations that are unknown or too strong.

    Raises:
        RunError: Unknown name.
        DynslamError: A strength out of its range.
    """
    degradations = set(Degradation.__dataclass_fields__) - {"seed"}
    for unknown in sorted(set(strengths) - degradations):
        raise RunError(f"unknown degradation '{unknown}'", did_you_mean(unknown, degradations))
    Degradation(seed=0, **strengths)


def _configure(spec: RunSpec, key: str) -> _Configuration:
    """Look up the tracker of a run and its settings.

    Raises:
        DynslamError: One is unknown, does not fit, or a package that the tracker needs is missing.
    """
    tracker = TRACKERS.get(spec.tracker)
    if missing := tracker.missing():
        raise RunError(
            f"tracker '{tracker.id}' needs a package that is not installed", "; ".join(missing)
        )
    settings = resolve_settings(tracker, spec.settings)
    return _Configuration(key, tracker, settings, flatten(settings))


def _asked(
    spec: RunSpec,
    configured: _Configuration,
    part: SequencePart,
    device: str,
    start_map: StartMap | None,
) -> dict[str, Any]:
    """The request in a run's identity: the entries `record.ASKED`."""
    settings = configured.flat
    if start_map is not None:  # its digest is among the weights
        settings = settings | {MAP_SETTING: ""}
    asked: dict[str, Any] = {
        "scheme": IDENTITY_SCHEME,
        "tracker": configured.tracker.id,
        "settings": settings,
        "sequence": part.id,
        "frames": [part.start, part.stop],
        "offset": spec.offset,
        "stride": part.stride,
        "seed": spec.seed,
        "device": device,
        "threads": spec.threads,
    }
    if spec.cache:
        asked["cache"] = True
    degrade = {name: value for name, value in sorted(spec.degrade.items()) if value}
    return asked | {
        "realtime": spec.realtime,
        "drop_share": spec.drop_share,
        "degrade": degrade,
    }


def _files_of(
    tracker: TrackerSpec, settings: Settings, source: str
) -> tuple[dict[str, Any], tuple[Path, ...]]:
    """The weights and files by which a run is made.

    Returns:
        The entries ``weights`` and ``files`` of its identity, and the files of its program.

    Raises:
        DynslamError: One cannot be read.
    """
    weights = named_digests(settings, words=is_outside_package(tracker.entry_point))
    group = getattr(settings, "segmentation", None)
    if source in ("embedded", *CHECKPOINTS) and isinstance(group, SegmentationSettings):
        weights[source] = weights_digest(group.model_copy(update={"source": source}))
    named: dict[str, Any] = {"weights": weights}
    if not tracker.files:
        return named, ()
    with translate_errors(PluginError, f"cannot read a file of tracker '{tracker.id}'"):
        files = tuple(map(Path, load_object(tracker.files)(settings)))
        return named | {"files": contents_digest(files)}, files


def libraries() -> dict[str, str]:
    """Versions of the modules that compute with a run's data, and the paths that are searched before them."""
    imports = ImportPath(sys.path)
    identities = {name: library_identity(module, imports) for name, module in LIBRARIES.items()}
    return identities | search_path()


def source_digests(parts: Iterable[str]) -> dict[str, str]:
    """Digest of the code of this package that each part of a run uses; see `own_code.modules_by_component`.

    Runs on sequences of two kinds share the parts of their tracker: by part it shows whether one
    program made both.

    Raises:
        RunError: What is loaded may be older than the sources, see `module_graph.check_byte_code`.
    """
    check_byte_code()
    return dict(_code_digests(module_graph(), tuple(parts)))


@lru_cache(maxsize=1024)
def _code_digests(graph: ModuleGraph, parts: tuple[str, ...]) -> Mapping[str, str]:
    """The digests that `source_digests` gives, for the modules of one graph."""
    return {
        part: graph.code_digest(modules)[:16]
        for part, modules in modules_by_component(graph, parts).items()
    }


def check_unchanged(run: ResolvedRun, *, begun: bool = False) -> None:
    """Check that what a run is made of is what was looked up for it: data, code, files, weights, map.

    Args:
        run: The run.
        begun: Whether it was begun: what a program's command names may be its output then.

    Raises:
        RunError: Something has changed since.
        DynslamError: Something cannot be read any more.
    """
    if _code_digests(read_module_graph(), tuple(run.identity["parts"])) != run.identity["source"]:
        raise RunError(
            "the code of dynslam-bench has changed since this process began", "start it again"
        )
    before = run.identity
    now = resolve(run.spec).identity
    # what a program's command names may be its output once it has begun
    now["files"] = before.get("files")
    if run.files and not begun:
        with translate_errors(PluginError, f"cannot read a file of tracker '{run.tracker.id}'"):
            now["files"] = contents_digest(run.files)
    # weights that had no digest before do not count
    now["weights"] = {
        name: now["weights"].get(name) if value else value
        for name, value in before["weights"].items()
    }
    changed = [name for name in before if now.get(name) != before[name]]
    if changed:
        words = {
            "content": f"sequence '{run.sequence.id}'",
            "files": f"the program of tracker '{run.tracker.id}'",
            "weights": "a file that the settings name",
        }
        what = ", ".join(words.get(name, name) for name in changed)
        hint = "the run is not stored; ask again, and let no tracker write files beside its code or data"
        raise RunError(f"{what} has changed since the run was asked for", hint)


def start_map_of(
    settings: Settings, camera: Camera, sensors: Sensors, digests: dict[str, str]
) -> StartMap | None:
    """The map that settings name; None where they name none.

    Args:
        settings: A tracker's complete settings.
        camera: Intrinsics of the sequence's images, as the tracker sees them.
        sensors: Sensors that the tracker uses.
        digests: Digests of the files that the settings name, by the setting's dotted name.

    Raises:
        SettingsError: The tracker has features of its own; the file is no map, or one of another
            camera, other features or another sensor.
    """
    backend = getattr(settings, "backend", None)
    features = getattr(settings, "features", None)
    if not isinstance(backend, BackendSettings) or not backend.map.file:
        return None
    if not isinstance(features, FeatureSettings):
        raise SettingsError(
            f"'{MAP_SETTING}' is set, and the tracker's features are none that maps are made of"
        )
    path = Path(backend.map.file).expanduser()
    saved = read_map(path)
    made_of = MapFeatures(
        extractor=features.extractor, levels=features.levels, scale_factor=features.scale_factor
    )
    saved.check(camera, made_of, sensors, str(path))
    return StartMap(
        digest=digests[MAP_SETTING],
        file=str(path),
        made_by=saved.header.made_by,
        keyframes=len(saved.arrays["kf_id"]),
        points=len(saved.arrays["id"]),
        localisation_only=backend.map.localisation_only,
    )
