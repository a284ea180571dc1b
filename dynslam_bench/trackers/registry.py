"""All trackers by id: built in, from entry points, from the environment variable, from a file."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping
from typing import Any

from dynslam_bench.core.errors import DynslamError, TrackerError
from dynslam_bench.core.plugins import Registry, load_object
from dynslam_bench.core.settings import Settings, apply_overrides

from .protocol import Tracker, TrackerContext, TrackerSpec


def _builtin() -> Iterable[TrackerSpec]:
    from . import specs

    return specs.all_specs()


TRACKERS: Registry[TrackerSpec] = Registry("trackers", TrackerSpec, _builtin)


def resolve_settings(spec: TrackerSpec, overrides: Mapping[str, Any] | None = None) -> Settings:
    """The tracker's default settings with overrides (dotted name to value) applied.

    Raises:
        SettingsError: Unknown name or unfit value.
    """
    return apply_overrides(spec.settings(), overrides or {})


def build_tracker(
    spec: TrackerSpec | str, settings: Settings | Mapping[str, Any] | None = None, context: TrackerContext | None = None
) -> Tracker:
    """Load and construct a tracker.

    Args:
        spec: A spec, an id, ``module:Attr`` or ``file.py:Attr``.
        settings: Its settings, or overrides of the defaults by dotted name.
        context: Where it runs.

    Raises:
        PluginError: No such tracker.
        SettingsError: The settings do not fit.
        TrackerError: A required module is missing, or the factory failed.
    """
    if isinstance(spec, str):
        spec = TRACKERS.get(spec)
    if not isinstance(settings, Settings):
        settings = resolve_settings(spec, settings)
    missing = spec.missing()
    if missing:
        raise TrackerError(f"tracker '{spec.id}' needs a package that is not installed", "; ".join(missing))
    factory = load_object(spec.entry_point)
    arguments = {"context": context or TrackerContext()} if _takes_context(factory) else {}
    try:
        tracker = factory(settings, **arguments)
    except DynslamError:
        raise
    except Exception as error:
        raise TrackerError(f"tracker '{spec.id}' cannot be built: {type(error).__name__}: {error}") from error
    if not isinstance(tracker, Tracker):
        raise TrackerError(f"'{spec.entry_point}' gave a {type(tracker).__name__} without reset() and track()")
    return tracker


def _takes_context(factory: Any) -> bool:
    try:
        return "context" in inspect.signature(factory).parameters
    except (TypeError, ValueError):
        return False
