"""Guarded discovery of plug-ins: one scheme for trackers, segmenters, features, flows, filters and sequences.

A plug-in is a light *spec* (importable without torch or OpenCV) with an `id` and an `entry_point` ``"module:Attr"``
that loads the heavy part. Specs are found by ``module:Attr`` or ``file.py:Attr`` of the user, and by id: the built-in
ones, those of the environment variable ``DYNSLAM_BENCH_PLUGINS``, and those of the entry-point groups
``dynslam_bench.<kind>``. No plug-in may take the id of a built-in one. A plug-in that fails to load never breaks the
rest; the reason is kept and shown by ``trackers doctor``.
"""

import importlib.util
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from importlib.metadata import entry_points
from operator import attrgetter
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, Literal, Protocol, TypeVar

from dynslam_bench.core.errors import DynslamError, PluginError, did_you_mean

ENVIRONMENT_VARIABLE = "DYNSLAM_BENCH_PLUGINS"
Kind = Literal["trackers", "segmenters", "features", "flow", "filters", "sequences"]


class Spec(Protocol):
    """What every plug-in spec has."""

    @property
    def id(self) -> str:
        """Unique name within its kind."""

    @property
    def entry_point(self) -> str:
        """``"module:Attr"`` of the class or factory."""


P = TypeVar("P", bound=Spec)
B = TypeVar("B")


@dataclass(frozen=True)
class Failure:
    """A plug-in that is not available, and why."""

    source: str
    reason: str


@dataclass(frozen=True)
class Found(Generic[P]):
    """A plug-in spec and where it came from: ``argument``, ``environment``, ``entry point (dist)``, ``built in``."""

    spec: P
    source: str


class Registry(Generic[P]):
    """All plug-ins of one kind.

    Args:
        kind: Which entry-point group to read.
        spec_type: What a plug-in's object must be an instance of.
        builtin: Returns the built-in specs; called once, on first use.
    """

    def __init__(self, kind: Kind, spec_type: type[P], builtin: Callable[[], Iterable[P]]) -> None:
        self.kind = kind
        self._spec_type = spec_type
        self._builtin = builtin
        self._found: dict[str, Found[P]] | None = None
        self._failures: list[Failure] = []

    def all(self) -> list[Found[P]]:
        """Every available plug-in, sorted by id."""
        return [plugin for _, plugin in sorted(self._discover().items())]

    def failures(self) -> list[Failure]:
        """The plug-ins that could not be loaded, with reasons."""
        self._discover()
        return list(self._failures)

    def get(self, name: str) -> P:
        """The spec of an id, or of ``module:Attr`` / ``file.py:Attr``.

        Raises:
            PluginError: Unknown id (with a did-you-mean), or the named object cannot be loaded or is no spec.
        """
        plugins = self._discover()
        if name in plugins:
            return plugins[name].spec
        if ":" in name:
            spec = self._check(load_object(name), name)
            registered = plugins.get(spec.id)  # under a built-in id tables could not tell them apart
            if registered is not None and registered.source == "built in" and registered.spec != spec:
                raise PluginError(f"{name} has the id '{spec.id}', which is built in", "give the plug-in another id")
            return spec
        broken = [f"{failure.source} failed to load: {failure.reason}" for failure in self._failures]
        named = [line for line in broken if name in line]
        hints = named[:1] or [did_you_mean(name, plugins), *broken[:1]]
        raise PluginError(f"unknown {self.kind.rstrip('s')} '{name}'", "; ".join(filter(None, hints)))

    def refresh(self) -> None:
        """Forget what was discovered, e.g. after the environment variable changed."""
        self._found = None
        self._failures = []
        _entry_points.cache_clear()

    def _discover(self) -> dict[str, Found[P]]:
        if self._found is None:
            self._found = {}
            for spec in self._builtin():
                self._add(spec, "built in")
            for target in _environment_targets(self.kind):
                self._add(target, f"{ENVIRONMENT_VARIABLE}: {target}")
            installed = _entry_points(*sys.path).select(group=f"dynslam_bench.{self.kind}")
            for point in sorted(installed, key=attrgetter("name")):
                distribution = point.dist.name if point.dist else "unknown distribution"
                self._add(f"{point.module}:{point.attr}", f"entry point '{point.name}' of {distribution}")
        return self._found

    def _add(self, plugin: P | str, source: str) -> None:
        """Take a spec, or the object that a target names; keep the reason if that is not possible."""
        assert self._found is not None
        try:
            spec = self._check(load_object(plugin) if isinstance(plugin, str) else plugin, source)
            if spec.id in self._found:
                raise PluginError(f"id '{spec.id}' is already taken by {self._found[spec.id].source}")
        except Exception as error:  # a foreign plug-in may raise anything
            self._failures.append(Failure(source, _reason(error)))
        else:
            self._found[spec.id] = Found(spec, source)

    def _check(self, value: object, source: str) -> P:
        if isinstance(value, self._spec_type):
            return value
        raise PluginError(
            f"{source} is a {type(value).__name__}, not a {self._spec_type.__name__}", "name the spec, not the class"
        )


@cache
def _entry_points(*_path: str) -> Any:
    """Those of all distributions on the import path; reading them takes 12 ms."""
    return entry_points()


def load_object(target: str) -> Any:
    """Import ``package.module:Attr`` or ``path/to/file.py:Attr``.

    Raises:
        PluginError: The module cannot be imported, would end this process, or lacks the attribute; carries the original
            reason.
    """
    location, separator, attribute = target.rpartition(":")
    if not separator or not location or not attribute:
        raise PluginError(
            f"'{target}' is not module:Attr", "for example my_package.trackers:SPEC or my_tracker.py:SPEC"
        )
    if not _is_imported(location):
        check_import(location)
    try:
        module = import_module(location)
    except (Exception, SystemExit) as error:
        raise PluginError(f"cannot import {location}: {_reason(error)}") from error
    try:
        return attrgetter(attribute)(module)
    except AttributeError:
        public = [name for name in vars(module) if not name.startswith("_")]
        raise PluginError(f"{location} has no '{attribute}'", did_you_mean(attribute, public)) from None


def build_plugin(
    kind: str, spec: Spec, protocol: type[B], fault: type[DynslamError], call: Callable[[Any], object]
) -> B:
    """Load a plug-in's factory, call it, and check what it gives.

    Args:
        kind: For messages, e.g. ``flow``.
        spec: The plug-in.
        protocol: What the factory has to give.
        fault: Type of the error.
        call: Calls the factory that it is given.

    Raises:
        DynslamError: Of the type `fault` where the factory fails or gives something else; its own pass unchanged.
    """
    factory = load_object(spec.entry_point)
    try:
        built = call(factory)
    except DynslamError:
        raise
    except Exception as error:  # a plug-in may raise anything
        raise fault(f"{kind} '{spec.id}' cannot be built: {type(error).__name__}: {error}") from error
    if not isinstance(built, protocol):
        raise fault(f"'{spec.entry_point}' gave a {type(built).__name__}, not a {protocol.__name__}")
    return built


def import_module(location: str) -> ModuleType:
    """The module of a name, or of the path of a ``.py`` file; whatever the import raises."""
    return _load_file(Path(location)) if location.endswith(".py") else importlib.import_module(location)


def _is_imported(location: str) -> bool:
    """Whether a module is there already, comes with this package, or does not exist as a file."""
    if not location.endswith(".py"):
        return location in sys.modules or location.partition(".")[0] == __name__.partition(".")[0]
    return _module_name(Path(location)) in sys.modules or not Path(location).expanduser().is_file()


def _module_name(path: Path) -> str:
    return f"_dynslam_bench_plugin_{sha256(str(path.expanduser().resolve()).encode()).hexdigest()[:12]}"


def _load_file(path: Path) -> ModuleType:
    resolved = path.expanduser().resolve()
    if not resolved.is_file():
        raise FileNotFoundError(f"no file {resolved}")
    name = _module_name(path)
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, resolved)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:  # from its text: byte code of an edit of equal length in the same second would pass for that of this one
        exec(compile(resolved.read_bytes(), resolved, "exec"), module.__dict__)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _environment_targets(kind: Kind) -> list[str]:
    """Targets of ``DYNSLAM_BENCH_PLUGINS="trackers=my.py:SPEC,flow=pkg.mod:SPEC"``; no ``kind=`` means a tracker."""
    items = [item.strip() for item in os.environ.get(ENVIRONMENT_VARIABLE, "").split(",")]
    pairs = [item.partition("=") if "=" in item else ("trackers", "=", item) for item in items if item]
    return [target for prefix, _, target in pairs if prefix == kind]


def _reason(error: BaseException) -> str:
    name = "" if isinstance(error, DynslamError) else type(error).__name__
    return ": ".join(filter(None, [name, *str(error).strip().splitlines()[-1:]]))


# -- whether a module can be imported at all: tried in a process of its own, which that may end ------------------------

ISOLATED_VARIABLE = "DYNSLAM_BENCH_ISOLATED"
"""Set in processes that may end by an import without harm: the children of runs, and the probes themselves."""
LIMIT_S = 120
_IMPORTED = 113
_PROBE = """
import os
from dynslam_bench.core.plugins import import_module
try:
    import_module(sys.argv[1])
except Exception:
    pass  # the caller meets it again and reports it
os._exit(int(sys.argv[2]))
"""


def python_command(code: str) -> list[str]:
    """The command of a Python process that imports what this process imports.

    ``python -m`` and ``python -c`` import from the working folder first: in a checkout they would run its code
    instead of the installed package's.
    """
    return [sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}\n{code}"]


def module_command(module: str) -> list[str]:
    """As `python_command`, for a module that is run as a program."""
    return python_command(f"import runpy; runpy.run_module({module!r}, run_name='__main__')")


@cache
def check_import(location: str) -> None:
    """Import a plug-in's module in a process of its own, once for every location.

    What the import raises is left to the caller's own import; here counts that it comes to an end and that the process
    lives on: ``sys.exit``, ``os._exit``, a crash of a native library or an endless loop would end, or hang, the
    importing process.

    Args:
        location: Name of a module, or path of a ``.py`` file.

    Raises:
        PluginError: It does not; with how it ended.
    """
    if os.environ.get(ISOLATED_VARIABLE):
        return
    command = [*python_command(_PROBE), location, str(_IMPORTED)]
    quiet = subprocess.DEVNULL
    try:
        code = subprocess.run(
            command,
            env=os.environ | {ISOLATED_VARIABLE: "1"},
            timeout=LIMIT_S,
            check=False,
            stdin=quiet,
            stdout=quiet,
            stderr=quiet,
        ).returncode
    except subprocess.TimeoutExpired:
        raise PluginError(f"cannot import {location}: it is not done after {LIMIT_S} s") from None
    if code != _IMPORTED:
        how = f"exit code {code}" if code >= 0 else signal.Signals(-code).name
        raise PluginError(
            f"cannot import {location}: that ends the process ({how})",
            "a plug-in must not call sys.exit or os._exit when it is imported",
        )
