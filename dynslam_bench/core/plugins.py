"""Guarded discovery of plug-ins: one scheme for trackers, segmenters, features, flows, filters and sequences.

A plug-in is a light *spec* (importable without torch or OpenCV) with an `id` and an `entry_point`
``"module:Attr"`` that loads the heavy part. Specs are found by ``module:Attr`` or ``file.py:Attr``
of the user, and by id: the built-in ones, those of the environment variable
``DYNSLAM_BENCH_PLUGINS``, and those of the entry-point groups ``dynslam_bench.<kind>``. No plug-in
may take the id of a built-in one. A plug-in that fails to load never breaks the rest; the reason is
kept and shown by ``trackers doctor``.
"""

import importlib.util
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from operator import attrgetter
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, Literal, Protocol, TypeVar

from dynslam_bench.core.errors import DynslamError, PluginError, did_you_mean

ENVIRONMENT_VARIABLE = "DYNSLAM_BENCH_PLUGINS"
"""Lists plug-ins of the user, see `_environment_targets`."""
Kind = Literal["trackers", "segmenters", "features", "flow", "filters", "sequences"]


class Spec(Protocol):
    """The fields that every plug-in spec has."""

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
class Discovered(Generic[P]):
    """A plug-in spec and where it came from: ``argument``, ``environment``, ``entry point (dist)``, ``built in``."""

    spec: P
    source: str


@dataclass(frozen=True)
class Listed:
    """A plug-in that is listed and need not be imported yet.

    Attributes:
        target: ``module:Attr`` or ``file.py:Attr`` of its spec.
        source: Who lists it, in words.
        name: What the list calls it: the name of an entry point, by custom the spec's id; empty
            where there is none.
    """

    target: str
    source: str
    name: str = ""


class Registry(Generic[P]):
    """All plug-ins of one kind.

    A plug-in that is only listed is imported when it is asked for by its id, or when all are asked
    for: what another plug-in does at its import, such as patching numpy, must not reach runs and
    scores that do not use it.

    Args:
        kind: Which entry-point group to read.
        spec_type: What a plug-in's object must be an instance of.
        builtin: Returns the built-in specs; called once, on first use.
    """

    def __init__(self, kind: Kind, spec_type: type[P], builtin: Callable[[], Iterable[P]]) -> None:
        self.kind = kind
        self._spec_type = spec_type
        self._builtin_specs = builtin
        self._builtin: dict[str, P] | None = None
        self._discovered: dict[str, Discovered[P]] | None = None
        self._failures: list[Failure] = []

    def all(self) -> list[Discovered[P]]:
        """Every available plug-in, sorted by id; imports all that are listed."""
        return [plugin for _, plugin in sorted(self._discover().items())]

    def failures(self) -> list[Failure]:
        """The plug-ins that could not be loaded, with reasons; imports all that are listed."""
        self._discover()
        return list(self._failures)

    def builtin(self) -> dict[str, P]:
        """The built-in specs by id."""
        if self._builtin is None:
            self._builtin = {spec.id: spec for spec in self._builtin_specs()}
        return self._builtin

    def get(self, name: str) -> P:
        """The spec of an id, or of ``module:Attr`` / ``file.py:Attr``; imports no other plug-in.

        Raises:
            PluginError: Unknown id (with a did-you-mean), or the named object cannot be loaded or
                is no spec.
        """
        spec = self.find(name)
        if spec is not None:
            return spec
        if ":" in name:
            spec = self._check(load_object(name), name)
            # under a built-in id tables could not tell them apart
            builtin = self.builtin().get(spec.id)
            if builtin is not None and builtin != spec:
                raise PluginError(
                    f"{name} has the id '{spec.id}', which is built in",
                    "give the plug-in another id",
                )
            return spec
        raise self._unknown(name)

    def _unknown(self, name: str) -> PluginError:
        """The error for an id that no plug-in has; its hint says which ones failed to load."""
        plugins = self._discover()
        broken = [
            f"{failure.source} failed to load: {failure.reason}" for failure in self._failures
        ]
        # one whose source holds the name is most likely the plug-in that was asked for
        of_this_name = [line for line in broken if name in line]
        hints = of_this_name[:1] or [did_you_mean(name, plugins), *broken[:1]]
        hint = "; ".join(filter(None, hints))
        return PluginError(f"unknown {self.kind.rstrip('s')} '{name}'", hint)

    def find(self, name: str) -> P | None:
        """The spec of an id, None where no plug-in has it; imports no other plug-in."""
        if name in self.builtin():
            return self.builtin()[name]
        target = self.target_of(name)
        if target is None:
            return None
        try:
            return self._check(load_object(target), target)
        except PluginError:
            return None  # what is wrong with it is said where all are listed

    def target_of(self, name: str) -> str | None:
        """``module:Attr`` of the listed plug-in with an id; None for a built-in id, and where none has it."""
        # neither is listed anywhere
        is_file = name.rpartition(":")[0].endswith(".py")
        if name in self.builtin() or is_file:
            return None
        # entry points of that name first: by custom it is the id, and reading a spec takes a process
        of_this_name = [listed for listed in self.listed() if listed.name == name]
        others = [listed for listed in self.listed() if listed.name != name]
        for listed in (*of_this_name, *others):
            if described(listed.target).get("id") == name:
                return listed.target
        return None

    def listed(self) -> list[Listed]:
        """Plug-ins that the environment variable and the installed distributions list; nothing is imported.

        In the process of a run the variable lists what the run uses, and installed ones are left
        out; see `used`.
        """
        targets = [
            Listed(target, f"{ENVIRONMENT_VARIABLE}: {target}")
            for target in _environment_targets(self.kind)
        ]
        if os.environ.get(ISOLATED_VARIABLE):
            return targets
        return targets + self._installed()

    def _installed(self) -> list[Listed]:
        """Entry points that the installed distributions list."""
        targets = []
        installed = _entry_points(*sys.path).select(group=f"dynslam_bench.{self.kind}")
        for point in sorted(installed, key=attrgetter("name")):
            distribution = point.dist.name if point.dist else "unknown distribution"
            source = f"entry point '{point.name}' of {distribution}"
            targets.append(Listed(f"{point.module}:{point.attr}", source, point.name))
        return targets

    def refresh(self) -> None:
        """Forget what was discovered, e.g. after the environment variable changed."""
        self._discovered = None
        self._failures = []
        _entry_points.cache_clear()
        described.cache_clear()

    def _discover(self) -> dict[str, Discovered[P]]:
        """All plug-ins by id, imported once; the first one with an id wins."""
        if self._discovered is None:
            self._discovered = {}
            for spec in self.builtin().values():
                self._add(spec, "built in")
            in_environment = [listed for listed in self.listed() if not listed.name]
            for listed in (*in_environment, *self._installed()):
                self._add(listed.target, listed.source)
        return self._discovered

    def _add(self, plugin: P | str, source: str) -> None:
        """Take a spec, or the object that a target names; keep the reason if that is not possible."""
        assert self._discovered is not None
        try:
            value = load_object(plugin) if isinstance(plugin, str) else plugin
            spec = self._check(value, source)
            if spec.id in self._discovered:
                holder = self._discovered[spec.id].source
                raise PluginError(f"id '{spec.id}' is already taken by {holder}")
        except Exception as error:  # a foreign plug-in may raise anything
            self._failures.append(Failure(source, _reason(error)))
        else:
            self._discovered[spec.id] = Discovered(spec, source)

    def _check(self, value: object, source: str) -> P:
        """The value, if it is a spec of this kind.

        Raises:
            PluginError: It is none.
        """
        if isinstance(value, self._spec_type):
            return value
        raise PluginError(
            f"{source} is a {type(value).__name__}, not a {self._spec_type.__name__}",
            "name the spec, not the class",
        )


def used(names: Iterable[tuple[Registry[Any], str]]) -> str:
    """The value of `ENVIRONMENT_VARIABLE` that lists some plug-ins alone, for the process of a run.

    Args:
        names: Registries, and ids that the run uses of them; built-in ones are left out.
    """
    # built-in ones have no target, and need no list
    targets = [(registry.kind, registry.target_of(name)) for registry, name in names]
    return ",".join(f"{kind}={target}" for kind, target in targets if target is not None)


@cache
def _entry_points(*_path: str) -> Any:
    """The entry points of all distributions on an import path; reading them takes 12 ms.

    Args:
        *_path: The import path, so that another one is read again.
    """
    from importlib.metadata import entry_points

    return entry_points()


_IMPORTED_PLUGINS: set[str] = set()
"""The modules and files of plug-ins that this process has imported."""


def has_imported_plugins() -> bool:
    """Whether this process has imported foreign code, which may have changed what numbers it computes."""
    return bool(_IMPORTED_PLUGINS)


def load_object(target: str) -> Any:
    """Import ``package.module:Attr`` or ``path/to/file.py:Attr``.

    Raises:
        PluginError: The module cannot be imported, would end this process, or lacks the attribute;
            carries the original reason.
    """
    location, separator, attribute = target.rpartition(":")
    if not separator or not location or not attribute:
        raise PluginError(
            f"'{target}' is not module:Attr",
            "for example my_package.trackers:SPEC or my_tracker.py:SPEC",
        )
    # a module that hangs or exits is found out elsewhere first
    if not _is_imported(location):
        check_import(location)
    try:
        module = import_module(location)
    except (Exception, SystemExit) as error:
        raise PluginError(f"cannot import {location}: {_reason(error)}") from error
    # from here on, numbers of this process may depend on it
    if location.endswith(".py") or not _is_of_this_package(location):
        _IMPORTED_PLUGINS.add(location)
    try:
        return attrgetter(attribute)(module)
    except AttributeError:
        public = [name for name in vars(module) if not name.startswith("_")]
        raise PluginError(
            f"{location} has no '{attribute}'", did_you_mean(attribute, public)
        ) from None


def build_plugin(
    kind: str,
    spec: Spec,
    protocol: type[B],
    fault: type[DynslamError],
    call: Callable[[Any], object],
) -> B:
    """Load a plug-in's factory, call it, and check what it gives.

    Args:
        kind: For messages, e.g. ``flow``.
        spec: The plug-in.
        protocol: What the factory has to give.
        fault: Type of the error.
        call: Calls the factory that it is given.

    Raises:
        DynslamError: Raised as `fault` where the factory fails or gives something else. A
            `DynslamError` of the factory passes unchanged.
    """
    # what the factory raises names the plug-in
    factory = load_object(spec.entry_point)
    try:
        built = call(factory)
    except DynslamError:
        raise
    except Exception as error:  # a plug-in may raise anything
        raise fault(
            f"{kind} '{spec.id}' cannot be built: {type(error).__name__}: {error}"
        ) from error
    # a wrong object is refused here, not in the middle of a run
    if not isinstance(built, protocol):
        raise fault(
            f"'{spec.entry_point}' gave a {type(built).__name__}, not a {protocol.__name__}"
        )
    return built


def import_module(location: str) -> ModuleType:
    """Import a module by its name, or by the path of a ``.py`` file.

    Raises:
        BaseException: Whatever the import raises.
    """
    if location.endswith(".py"):
        return _load_file(Path(location))
    return importlib.import_module(location)


def _is_imported(location: str) -> bool:
    """Whether a module is there already, comes with this package, or does not exist as a file."""
    if not location.endswith(".py"):
        return location in sys.modules or _is_of_this_package(location)
    file = Path(location)
    return _module_name(file) in sys.modules or not file.expanduser().is_file()


def _is_of_this_package(module: str) -> bool:
    return module.partition(".")[0] == __name__.partition(".")[0]


def _module_name(path: Path) -> str:
    """The name of a file's module, made of path and content: an edited file is imported again."""
    file = path.expanduser().resolve()
    content = file.read_bytes() if file.is_file() else b""
    return f"_dynslam_bench_plugin_{sha256(str(file).encode() + content).hexdigest()[:12]}"


def _load_file(path: Path) -> ModuleType:
    """Run a ``.py`` file as a module, once for each content."""
    resolved = path.expanduser().resolve()
    if not resolved.is_file():
        raise FileNotFoundError(f"no file {resolved}")
    name = _module_name(path)
    if name in sys.modules:
        return sys.modules[name]
    # it stands among the loaded modules while it runs, as pickle and dataclasses expect
    spec = importlib.util.spec_from_file_location(name, resolved)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    # compile its text: cached byte code of an edit of equal length within the same second would pass
    # for that of this text
    try:
        exec(compile(resolved.read_bytes(), resolved, "exec"), module.__dict__)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _environment_targets(kind: Kind) -> list[str]:
    """Targets of ``DYNSLAM_BENCH_PLUGINS="trackers=my.py:SPEC,flow=pkg.mod:SPEC"``; no ``kind=`` means a tracker."""
    targets = []
    for item in os.environ.get(ENVIRONMENT_VARIABLE, "").split(","):
        text = item.strip()
        if not text:
            continue
        # "kind=target"; a target alone is a tracker's
        prefix, separator, target = text.partition("=")
        if not separator:
            prefix = "trackers"
            target = text
        if prefix == kind:
            targets.append(target)
    return targets


def _reason(error: BaseException) -> str:
    """The last line of an error's text, behind its type if it is none of this package's."""
    name = "" if isinstance(error, DynslamError) else type(error).__name__
    last_line = str(error).strip().splitlines()[-1:]
    return ": ".join(filter(None, [name, *last_line]))


# -- whether a module can be imported at all: tried in a process of its own, which that may end ----

ISOLATED_VARIABLE = "DYNSLAM_BENCH_ISOLATED"
"""Set in processes that may end by an import without harm: the children of runs, and the probes themselves."""
LIMIT_S = 120
"""Seconds that the import of a plug-in may take."""
_IMPORTED = 113
"""Exit code of a probe whose import came to an end."""
_PROBE = """
import json, os
from dynslam_bench.core.plugins import import_module, load_object
location, target, code, pipe = sys.argv[1:]
try:
    import_module(location)
    if target:
        spec = load_object(target)
        about = {"id": str(spec.id), "sequences": list(map(str, getattr(spec, "sequences", ())))}
        os.write(int(pipe), json.dumps(about).encode())
except Exception:
    pass  # the caller meets it again and reports it
os._exit(int(code))
"""


def python_command(code: str) -> list[str]:
    """The command of a Python process that imports what this process imports.

    ``python -m`` and ``python -c`` import from the working folder first: in a checkout they would
    run its code instead of the installed package's.
    """
    return [sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}\n{code}"]


def module_command(module: str) -> list[str]:
    """The command of a Python process that runs a module as a program, see `python_command`."""
    return python_command(f"import runpy; runpy.run_module({module!r}, run_name='__main__')")


@cache
def check_import(location: str) -> None:
    """Import a plug-in's module in a process of its own, once for every location.

    The import has to come to an end, and the process has to live on: ``sys.exit``, ``os._exit``, a
    crash of a native library or an endless loop would end, or hang, the importing process. What the
    import raises is left to the caller's own import.

    Args:
        location: Name of a module, or path of a ``.py`` file.

    Raises:
        PluginError: The import hangs or ends the process.
    """
    if not os.environ.get(ISOLATED_VARIABLE):
        _probe(location, "")


@cache
def described(target: str) -> dict[str, Any]:
    """``id`` and ``sequences`` of a plug-in's spec, read in a process of its own; empty where it cannot be loaded.

    A process that makes a run (`ISOLATED_VARIABLE` is set) loads the spec itself: it may be changed by it.

    Args:
        target: ``module:Attr`` or ``file.py:Attr``.
    """
    location = target.rpartition(":")[0]
    try:
        if os.environ.get(ISOLATED_VARIABLE):
            spec = load_object(target)
            return {"id": str(spec.id), "sequences": list(map(str, getattr(spec, "sequences", ())))}
        answer = _probe(location, target)
    except Exception:  # it fails in any way; `Registry.failures` says how
        return {}
    return dict(json.loads(answer)) if answer else {}


def _probe(location: str, target: str) -> bytes:
    """Import a module in a process of its own, and read a spec of it.

    Args:
        location: Name of a module, or path of a ``.py`` file.
        target: The spec; empty to import the module alone.

    Returns:
        What the process wrote of the spec, see `_PROBE`.

    Raises:
        PluginError: The process hangs, or it is ended by the import.
    """
    # the plug-in may print: the answer has a pipe of its own
    quiet = subprocess.DEVNULL
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as answer:
        try:
            code = subprocess.run(
                [*python_command(_PROBE), location, target, str(_IMPORTED), str(writing)],
                env=os.environ | {ISOLATED_VARIABLE: "1"},
                timeout=LIMIT_S,
                check=False,
                stdin=quiet,
                stdout=quiet,
                stderr=quiet,
                pass_fds=[writing],
            ).returncode
        except subprocess.TimeoutExpired:
            raise PluginError(
                f"cannot import {location}: it is not done after {LIMIT_S} s"
            ) from None
        finally:
            os.close(writing)
        # any other exit code means that the import has ended the process
        if code != _IMPORTED:
            how = f"exit code {code}" if code >= 0 else signal.Signals(-code).name
            raise PluginError(
                f"cannot import {location}: that ends the process ({how})",
                "a plug-in must not call sys.exit or os._exit when it is imported",
            )
        return answer.read()
