"""Modules of this package that decide the result of a run: those that its components import.

The components are the tracker's entry point, its filters, features, flow and segmenter, the reader or
renderer of the sequence, and the environment with the run's loop. A change of any other module
changes no run.
"""

from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

from dynslam_bench.contracts import TrackerSpec
from dynslam_bench.core.module_graph import PACKAGE, PLUMBING, ModuleGraph, module_graph
from dynslam_bench.core.plugins import Registry
from dynslam_bench.core.plugins import used as used_plugins
from dynslam_bench.core.reads import BaseFolders
from dynslam_bench.core.settings import Settings
from dynslam_bench.features.registry import FEATURES
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.flow.registry import FLOWS, spec_of
from dynslam_bench.flow.settings import FlowMethodSettings
from dynslam_bench.segmentation.build_segmenter import SEGMENTERS
from dynslam_bench.sequences.catalogue import DATASETS
from dynslam_bench.trackers.registry import TRACKERS
from dynslam_bench.trackers.systems.composition import (
    UnfilteredSystemSettings,
    component_entry_points,
)

ENVIRONMENT_MODULES = ("envs.slam_env", "runs.loop")
DEGRADED_FRAMES = "envs.wrappers"
"""Needed by runs with degraded or dropped frames alone."""
REGISTRY_MODULES = ("trackers.registry", "sequences.catalogue", "sequences.synthetic")
"""They look up what a name stands for; what they find is part of the identity by itself."""
RESULT_NEUTRAL_MODULES = (
    "envs.rendering",
    "envs.wrappers",
    "runs.artifacts",
    "runs.exchange.recording",
    "runs.layout",
    "runs.process.failures",
    "runs.record",
    "runs.store",
    "segmentation.build_segmenter",
    "sequences.decoded",
)
"""Modules that the environment and the loop draw and store with; masks count with the systems that have them."""
PACKAGES_FOR_PLUGINS = (
    "contracts",
    "core",
    "culling",
    "envs",
    "evaluation",
    "features",
    "flow",
    "geometry",
    "segmentation",
    "sequences",
    "slam",
    "trackers",
)
"""The packages that a plug-in may use: what it imports of this package is known only while it runs."""


ALWAYS_USED = "the environment"
"""Stands among the components of a run for the environment with the run's loop."""
PLUGINS = "what plug-ins may use"
"""Stands among the components of a run with plug-ins for the packages `PACKAGES_FOR_PLUGINS`."""


def components_of_run(
    tracker: TrackerSpec,
    settings: Settings,
    source: str,
    reader: str,
    *,
    changes_frames: bool,
) -> list[str]:
    """Components of a run beside the environment: entry points, and modules of the sequence, sorted.

    An identity stores them as ``parts``.

    Args:
        tracker: The tracker.
        settings: Its complete settings.
        source: Where its masks come from; empty for a tracker without a semantic stage.
        reader: The module that reads or renders the sequence, see `sequences.view.reader_of`.
        changes_frames: Whether frames are degraded or dropped.
    """
    # the tracker with its filters, features, flow and masks, and the reader of the sequence
    components = {*entry_points_of(tracker, settings, source), reader}
    if changes_frames:
        components.add(f"{PACKAGE}.{DEGRADED_FRAMES}")
    return sorted(components)


def modules_by_component(graph: ModuleGraph, components: Collection[str]) -> dict[str, list[str]]:
    """The modules of this package that decide a run's result, by the component of the run that uses them.

    Args:
        graph: The package's modules.
        components: See `components_of_run`.

    Returns:
        The modules of each component, sorted; those of `ALWAYS_USED`, and those of `PLUGINS` where a
        component lies outside this package.
    """
    # what decides no result, and what only looks up the others
    never = [PACKAGE, *PLUMBING, *(f"{PACKAGE}.{name}" for name in REGISTRY_MODULES)]
    # each component brings what it imports
    environment = [f"{PACKAGE}.{name}" for name in ENVIRONMENT_MODULES]
    beside_the_loop = [f"{PACKAGE}.{name}" for name in RESULT_NEUTRAL_MODULES]
    modules = {ALWAYS_USED: graph.closure(environment, [*never, *beside_the_loop])}
    for component in components:
        modules[component] = graph.closure([module_of(component)], never)
    # what a plug-in imports is known only while it runs: all that it may
    if any(map(is_outside_package, components)):
        modules[PLUGINS] = sorted(modules_for_plugins(graph))
    return modules


def modules_of_run(graph: ModuleGraph, components: Collection[str]) -> list[str]:
    """The modules of this package that decide a run's result, sorted; see `modules_by_component`."""
    used: set[str] = set()
    for modules in modules_by_component(graph, components).values():
        used.update(modules)
    return sorted(used)


def modules_for_plugins(graph: ModuleGraph) -> list[str]:
    """The modules of all packages that a plug-in may use."""
    packages = tuple(f"{PACKAGE}.{name}." for name in PACKAGES_FOR_PLUGINS)
    return [module for module in graph.modules if f"{module}.".startswith(packages)]


def package_code() -> str:
    """Digest of all code that any run may use: two machines of a cluster need the same."""
    graph = module_graph()
    return graph.code_digest(modules_for_plugins(graph))


def plugins_of_run(tracker: str, settings: Settings, source: str, sequence: str) -> str:
    """The listed plug-ins that a run names by their ids, as the environment variable of plug-ins lists them.

    Args:
        tracker: As it was asked for.
        settings: Its complete settings.
        source: Where its masks come from.
        sequence: As it was asked for.
    """
    # every name that a registry is asked for, with its registry
    names: list[tuple[Registry[Any], str]] = [
        (TRACKERS, tracker),
        (DATASETS, sequence.partition("/")[0]),
    ]
    # extractor and flow are named by settings
    for group in groups_of(settings):
        if isinstance(group, FeatureSettings):
            names.append((FEATURES, group.extractor))
        if isinstance(group, FlowMethodSettings):
            names.append((FLOWS, group.plugin or group.method))
    if source not in ("", "none"):
        names.append((SEGMENTERS, segmenter_of(source)))
    return used_plugins(names)


def module_of(component: str) -> str:
    """The module of an entry point ``module:Attr`` or ``file.py:Attr``; a module's name stays as it is."""
    return component.rpartition(":")[0] or component


def entry_points_of(tracker: TrackerSpec, settings: Settings, source: str) -> Iterator[str]:
    """The entry points of all that a tracker is made of."""
    # the tracker itself, then its components
    yield tracker.entry_point
    if isinstance(settings, UnfilteredSystemSettings):
        yield from component_entry_points(settings)
    for group in groups_of(settings):
        if isinstance(group, FeatureSettings):
            yield FEATURES.get(group.extractor).entry_point
        if isinstance(group, FlowMethodSettings):
            yield spec_of(group).entry_point
    if source not in ("", "none"):
        yield SEGMENTERS.get(segmenter_of(source)).entry_point


def groups_of(settings: Settings) -> Iterator[Settings]:
    """The groups of settings, at any depth, and the settings themselves."""
    yield settings
    for _, value in settings:
        if isinstance(value, Settings):
            yield from groups_of(value)


def segmenter_of(source: str) -> str:
    """The id of the segmenter behind a source of masks: ``onnx`` of ``onnx:PATH``, ``mine`` of ``plugin:mine``."""
    kind, _, argument = source.partition(":")
    return argument if kind == "plugin" else kind


def base_folders_of(tracker: TrackerSpec, components: Iterable[str]) -> BaseFolders:
    """The folders in which names of files begin that a run's plug-ins and programs read, as they lie here.

    A plug-in's folder is that of the tracker's file. Where the tracker is none, it is that of the
    component whose file's name comes first.

    Args:
        tracker: The tracker.
        components: See `components_of_run`.
    """
    # files of plug-ins: the tracker's, else those of the components
    if is_file(tracker.entry_point):
        files = [Path(module_of(tracker.entry_point)).absolute()]
    else:
        files = [
            Path(module_of(component)).absolute() for component in components if is_file(component)
        ]
    if not files:
        return BaseFolders(plugin=None, work=Path.cwd())
    # one folder stands for all, and the same one on every machine
    first = min(files, key=lambda file: (file.name, file))
    return BaseFolders(plugin=first.parent, work=Path.cwd())


def portable_name(component: str, base_folders: BaseFolders) -> str:
    """An entry point as it stands in identities: equal wherever the folder of its file lies."""
    return base_folders.name(str(Path(component).absolute())) if is_file(component) else component


def is_file(component: str) -> bool:
    """Whether an entry point is in a file that is not installed, ``file.py:Attr``."""
    return module_of(component).endswith(".py")


def is_outside_package(component: str) -> bool:
    """Whether a component of a run lies outside this package."""
    return is_file(component) or module_of(component).partition(".")[0] != PACKAGE
