"""All trackers by id: built in, from entry points, from the environment variable, from a file."""

import inspect
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from dynslam_bench.contracts import Tracker, TrackerContext, TrackerSpec
from dynslam_bench.core import PluginError, TrackerError
from dynslam_bench.core.plugins import Registry, build_plugin, load_object
from dynslam_bench.core.settings import Settings, apply_overrides
from dynslam_bench.trackers.adapters.specs import ADAPTERS
from dynslam_bench.trackers.systems import emfoa_oft, published

KINDS = {
    "own": "this project's",
    "faithful-code": "published",
    "faithful-paper": "published",
    "inspired": "published",
    "assumed": "published",
    "external": "external",
    "control": "control",
}
"""Kind of a tracker by its provenance."""


def all_specs() -> list[TrackerSpec]:
    """The specs of all built-in trackers; imports neither torch nor OpenCV."""
    return [*ADAPTERS, *emfoa_oft.SPECS, *published.SPECS]


def tracker_groups() -> dict[str, list[list[TrackerSpec]]]:
    """All trackers by kind, for lists: ``this project's``, ``published``, ``external``, ``control`` and ``plug-in``.

    Returns:
        Kind to its trackers by id; each is a list of the tracker and its variants (``ID?...``).
    """
    groups: dict[str, list[list[TrackerSpec]]] = {
        kind: [] for kind in (*dict.fromkeys(KINDS.values()), "plug-in")
    }
    registered = TRACKERS.all()
    for tracker in registered:
        name = tracker.spec.id
        if "?" not in name:
            kind = KINDS[tracker.spec.provenance] if tracker.source == "built in" else "plug-in"
            variants = [other.spec for other in registered if other.spec.id.startswith(f"{name}?")]
            groups[kind].append([tracker.spec, *variants])
    return groups


class TrackerRegistry(Registry[TrackerSpec]):
    """All trackers; an id may carry a parameter, as in ``replay:trajectory.txt``.

    An exact id wins over ``id:value``, and that over ``module:Attr`` and ``file.py:Attr``. A name
    is read as ``id:value`` only if the part before its first colon is the id of a tracker that
    takes a parameter.
    """

    def get(self, name: str) -> TrackerSpec:
        """The spec of an id, of ``id:value``, or of ``module:Attr`` / ``file.py:Attr``; imports no other plug-in.

        Raises:
            PluginError: Unknown id (with a did-you-mean), an empty value, or the named object is no
                spec.
        """
        prefix, separator, value = name.partition(":")
        if separator and self.find(name) is None:
            spec = self.find(prefix)
            if spec is not None and spec.parameter:
                return _with_value(spec, value)
        return super().get(name)


def _with_value(spec: TrackerSpec, value: str) -> TrackerSpec:
    """The spec of ``id:value``; what a named file says becomes part of the version, and so of a run's identity."""
    if not value.strip():
        raise PluginError(
            f"'{spec.id}:' lacks its {spec.parameter}", f"write {spec.id}:{spec.parameter.upper()}"
        )
    described = load_object(spec.describe)(value) if spec.describe else {}

    # what the file says of itself replaces label, version and other fields; else a file's content is
    # a part of the version
    fields = {"label": f"{spec.label}: {value}", "version": spec.version} | described
    path = os.path.expanduser(value)  # noqa: PTH111 - it takes words that cannot be a path
    if not described and os.path.isfile(path):  # noqa: PTH113
        content = Path(path).read_bytes()
        fields["label"] = f"{spec.label}: {Path(path).name}"
        fields["version"] += f"+{sha256(content).hexdigest()[:12]}"
    fields["id"] = f"{spec.id}:{value}"
    fields["parameter"] = ""
    return replace(spec, **fields, fixed_settings={**spec.fixed_settings, spec.parameter: value})


TRACKERS: Registry[TrackerSpec] = TrackerRegistry("trackers", TrackerSpec, all_specs)


def resolve_settings(spec: TrackerSpec, overrides: Mapping[str, Any] | None = None) -> Settings:
    """The default settings with those that the id fixes, then the overrides (dotted name to value).

    Raises:
        SettingsError: Unknown name, unfit value, or values that do not go together.
    """
    settings = apply_overrides(spec.settings(), {**spec.fixed_settings, **(overrides or {})})
    settings.verify()
    return settings


def build_tracker(
    spec: TrackerSpec | str,
    settings: Settings | Mapping[str, Any] | None = None,
    context: TrackerContext | None = None,
) -> Tracker:
    """Load and construct a tracker.

    Args:
        spec: A spec, an id, ``id:value``, ``module:Attr`` or ``file.py:Attr``.
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
        raise TrackerError(
            f"tracker '{spec.id}' needs a package that is not installed", "; ".join(missing)
        )

    def construct(build: Callable[..., object]) -> object:
        """Call the factory, with the context if it takes one."""
        if "context" in inspect.signature(build).parameters:
            return build(settings, context=context or TrackerContext())
        return build(settings)

    return build_plugin("tracker", spec, Tracker, TrackerError, construct)  # type: ignore[type-abstract]
