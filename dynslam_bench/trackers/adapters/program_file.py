"""Programs that a TOML file describes: their commands, their settings, and the files that settings are written into.

A setting of the file becomes a field of a settings class, as `core.settings.tunable` makes one: what
is tuned, checked and shown knows no difference to a built-in tracker. Imports neither torch nor
OpenCV.
"""

import math
import os
import re
import shutil
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Generic, Literal, TypeVar, cast

from pydantic import ConfigDict, Field, create_model, field_validator, model_validator

from dynslam_bench.core import DynslamError, SettingsError, did_you_mean, read_text, read_toml
from dynslam_bench.core.code_files import files_of_command
from dynslam_bench.core.programs import program_environment
from dynslam_bench.core.records import Record, digest, validated
from dynslam_bench.core.settings import (
    Scalar,
    Settings,
    apply_overrides,
    field_names,
    flatten,
    names,
    tunable,
)
from dynslam_bench.geometry import Camera
from dynslam_bench.trackers.adapters.containers import Container, container_variables

ExitCode = Annotated[int, Field(ge=-64, le=255)]
"""Exit code of a program; ``-N`` if signal N killed it."""
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
"""Name of a setting, or of a group of settings."""
_PLACEHOLDER = re.compile(r"\{\{([\w.]+)\}\}|(?<!\$)\{([A-Za-z][\w.]*)\}")
"""``{{name}}``, which stands for the text ``{name}``; and ``{name}``, a placeholder. ``${name}`` is the shell's."""
CAMERA_NAMES = (
    "camera.width",
    "camera.height",
    "camera.fps",
    "camera.fx",
    "camera.fy",
    "camera.cx",
    "camera.cy",
    "camera.k1",
    "camera.k2",
    "camera.p1",
    "camera.p2",
    "camera.k3",
    "camera.baseline_m",
    "camera.bf",
    "camera.depth_factor",
)
"""Placeholders for the numbers of the camera; ``bf`` is the baseline times ``fx``."""
BATCH_NAMES = ("sequence", "associations", "camera", "output", "folder")
"""Placeholders for the paths that a program for whole sequences gets."""
COMMON_NAMES = ("here", "python", "threads", *CAMERA_NAMES)
"""Placeholders that every program has."""
_LITERAL: Any = Literal
"""Makes the type of a setting with choices, which are known only when a file is read."""
_ONE_LINE = r"^[^\x00-\x1f\x7f]*$"
"""A text that can stand in a command line and in a line of a file."""


class ProgramSettings(Settings):
    """Time limits of an external program that answers frame by frame."""

    start_timeout_s: float = Field(
        120.0, gt=0, description="seconds for starting and answering `reset`"
    )
    frame_timeout_s: float = Field(30.0, gt=0, description="seconds for answering one `track`")
    final_timeout_s: float = Field(120.0, gt=0, description="seconds for answering `finalize`")
    close_timeout_s: float = Field(
        5.0, gt=0, description="seconds for ending after `close` before it is killed"
    )


# -- settings that a file declares -----------------------------------------------------------------


class ProgramSetting(Record):
    """A setting as a file declares it; its type is that of its default value.

    Attributes:
        default: Value where nothing else is said.
        low: Lower end of the range that studies search, inclusive.
        high: Upper end of that range, inclusive.
        limits: What the program takes, where that is wider than the range.
        scale: ``log`` for values whose ratio matters.
        choices: The values that it may have, in place of a range.
        unit: Physical unit.
        meaning: One line.
    """

    default: Scalar
    low: int | float | None = None
    high: int | float | None = None
    limits: tuple[int | float, int | float] | None = None
    scale: Literal["linear", "log"] = "linear"
    choices: tuple[Scalar, ...] = ()
    unit: str = ""
    meaning: str = ""

    @model_validator(mode="after")
    def _check(self) -> "ProgramSetting":
        """Refuse what no study could search."""
        if self.choices:
            self._check_choices()
            return self
        if isinstance(self.default, bool | str):
            if self.low is not None or self.high is not None or self.limits is not None:
                raise ValueError(f"the default is {self.default!r}, which has no range")
            return self
        self._check_range(self.default)
        return self

    def _check_choices(self) -> None:
        """Refuse choices beside a range, repeated ones, or a default that is none of them."""
        if self.low is not None or self.high is not None or self.limits is not None:
            raise ValueError("it has choices and a range: leave one out")
        if len(set(map(str, self.choices))) < len(self.choices):
            raise ValueError("a choice is named twice")
        if self.default not in self.choices:
            shown = ", ".join(map(str, self.choices))
            raise ValueError(f"the default {self.default!r} is none of its choices: {shown}")

    def _check_range(self, default: float) -> None:
        """Refuse a range that is no range, or that the default or the limits contradict."""
        if not all(math.isfinite(number) for number in (default, *self._bounds)):
            raise ValueError("its numbers must be finite")
        if (self.low is None) != (self.high is None):
            raise ValueError("a range needs both low and high")
        if self.low is not None and self.high is not None:
            if self.low >= self.high:
                raise ValueError(f"low {self.low:g} is not below high {self.high:g}")
            if not self.low <= default <= self.high:
                raise ValueError(
                    f"the default {default:g} lies outside its range {self.low:g} to {self.high:g}"
                )
            if self.scale == "log" and self.low <= 0:
                raise ValueError(f"a log scale needs low above 0, not {self.low:g}")
        if self.limits is not None:
            least, most = self.limits
            outside = [number for number in (default, *self._bounds) if not least <= number <= most]
            if outside:
                raise ValueError(f"{outside[0]:g} lies outside its limits {least:g} to {most:g}")

    @property
    def _bounds(self) -> tuple[float, ...]:
        """The ends of the range."""
        return tuple(number for number in (self.low, self.high) if number is not None)

    def field(self) -> tuple[Any, Any]:
        """Type and field of a settings class."""
        if self.choices:
            return _LITERAL[self.choices], tunable(
                self.default, meaning=self.meaning, unit=self.unit
            )
        if isinstance(self.default, bool):
            return bool, tunable(self.default, meaning=self.meaning, unit=self.unit)
        if isinstance(self.default, str):
            return str, Field(self.default, description=self.meaning, pattern=_ONE_LINE)

        # a number: whole where all that is written of it is
        numbers = (self.default, *self._bounds)
        is_whole = all(isinstance(number, int) for number in numbers)
        kind: type[int] | type[float] = int if is_whole else float
        if self.low is not None:
            field = tunable(
                kind(self.default),
                meaning=self.meaning,
                low=self.low,
                high=self.high,
                scale=self.scale,
                limits=self.limits,
                unit=self.unit,
            )
            return kind, field
        least, most = self.limits or (None, None)
        return kind, Field(kind(self.default), description=self.meaning, ge=least, le=most)


Declared = dict[str, Any]
"""Settings by name: each a `ProgramSetting`, or `Declared` itself for a group."""


def read_declared(table: Mapping[str, Any], where: str, prefix: str = "") -> Declared:
    """The settings that a table declares; a table that holds tables alone is a group of them.

    Args:
        table: Name to the fields of `ProgramSetting`, or to a group.
        where: The file, for messages.
        prefix: Prefix of the names: ends in a dot, or is empty.

    Raises:
        SettingsError: A name or a field does not fit.
    """
    declared: Declared = {}
    for key, entry in table.items():
        name = f"{prefix}{key}"
        if not _NAME.fullmatch(key):
            raise SettingsError(
                f"{where}: setting '{name}' has a name that no placeholder can have",
                "use letters, digits and _, and begin with a letter",
            )
        if not isinstance(entry, dict):
            raise SettingsError(
                f"{where}: setting '{name}' is {entry!r}, not a table",
                f"write [settings.{name}] and default = {entry!r}",
            )
        is_group = bool(entry) and all(isinstance(value, dict) for value in entry.values())
        if is_group:
            declared[key] = read_declared(entry, where, f"{name}.")
        else:
            declared[key] = validated(
                ProgramSetting, entry, f"{where}: setting '{name}'", SettingsError
            )
    return declared


S = TypeVar("S", bound=Settings)


def settings_class(base: type[S], declared: Declared) -> type[S]:
    """A settings class with the declared settings beside those of `base`; one class for equal declarations.

    Raises:
        SettingsError: A setting has a name that the class needs itself.
    """
    for name in declared:
        if hasattr(base, name) or name in base.model_fields or name.startswith("model_"):
            raise SettingsError(
                f"a setting cannot be called '{name}', which the adapter has already",
                f"call it my_{name}, for example",
            )
    key = (base, repr(declared))
    if key not in _CLASSES:
        fields: dict[str, Any] = {}
        for name, entry in declared.items():
            if isinstance(entry, ProgramSetting):
                fields[name] = entry.field()
            else:
                group = settings_class(Settings, entry)
                fields[name] = (group, group())
        name = base.__name__
        _CLASSES[key] = create_model(name, __base__=base, __module__=base.__module__, **fields)
    return cast("type[S]", _CLASSES[key])


_CLASSES: dict[tuple[type[Settings], str], type[Settings]] = {}
"""Settings classes by base and declared settings: settings of one file are of one class."""


# -- what a file says ------------------------------------------------------------------------------


class ProgramFile(Record):
    """Content of a program's TOML file.

    Attributes:
        name: Shown in tables.
        command: Program and arguments, run without a shell. Placeholders are put in: settings by
            their name, ``{here}`` (the TOML file's folder), ``{python}`` (this one), ``{threads}``,
            and the numbers of the camera, as ``{camera.fx}``. A word that names a file below the
            TOML file's folder is that file.
        environment: Environment variables that it gets beside the usual ones: ``NAME`` is handed
            through, and its value counts in a run's identity; ``NAME=VALUE`` is set, placeholders
            included.
        exit_codes: Exit codes that are no failure; -N if signal N killed it.
        templates: Files of its working folder, each with the template beside the TOML file from
            which it is made.
        settings: What studies may tune, see `ProgramSetting`.
        presets: Settings by name, for ``--preset``.
        image: Container image in which it runs: a name for docker and podman, a ``.sif`` file for
            apptainer; empty for none.
        engine: What runs the image; empty for the first one that is here.
        gpu: Whether the container sees the GPUs.
        sensors: ``rgb`` for a program without depth.
        version: Part of a run's identity.
        license: SPDX id.
        citation: What to cite.
    """

    model_config = ConfigDict(extra="forbid")

    name: str = Field(min_length=1)
    command: list[str] = Field(min_length=1)
    environment: list[str] = Field(default=[])
    exit_codes: list[ExitCode] = Field(default=[0], min_length=1)
    templates: dict[str, str] = Field(default={})
    settings: dict[str, Any] = Field(default={})
    presets: dict[str, dict[str, Any]] = Field(default={})
    image: str = ""
    engine: Literal["", "docker", "podman", "apptainer"] = ""
    gpu: bool = False
    sensors: Literal["rgbd", "rgb"] = "rgbd"
    version: str = ""
    license: str = ""
    citation: str = ""

    @field_validator("templates")
    @classmethod
    def _in_the_working_folder(cls, templates: dict[str, str]) -> dict[str, str]:
        for target in templates:
            check_inside(target, "a file that a template makes")
        return templates

    @property
    def decisive(self) -> dict[str, Any]:
        """The fields that decide a result, settings apart: words about the program and ranges of settings do not."""
        words = {"name", "settings", "presets", "version", "license", "citation"}
        return self.model_dump(mode="json", exclude=words)


class BatchProgram(ProgramFile):
    """Content of the TOML file of `batch:FILE`.

    The command has ``{sequence}`` (a folder in TUM layout), ``{camera}`` (ORB-SLAM's YAML),
    ``{associations}``, ``{output}`` and ``{folder}`` (which holds these), too.

    Attributes:
        output: What it writes, a relative path in its working folder, which is new for every run.
        format: ``tum`` (stamp tx ty tz qx qy qz qw, camera to world), or ``indices``: the frame's
            index for the stamp.
    """

    output: str = "trajectory.txt"
    format: Literal["tum", "indices"] = "tum"

    @field_validator("output")
    @classmethod
    def _is_new(cls, output: str) -> str:
        """Refuse a path that may hold the trajectory of another run, or of another program."""
        check_inside(output, "output")
        return output

    @model_validator(mode="after")
    def _is_written_by_the_program(self) -> "BatchProgram":
        """Refuse a template that makes the output: it would be scored where the program writes nothing."""
        for target in self.templates:
            if os.path.normpath(target) == os.path.normpath(self.output):
                raise ValueError(
                    f"output: '{self.output}' is made of the template '{self.templates[target]}' before the program "
                    "starts: name the file that the program writes"
                )
        return self


class ServedProgram(ProgramFile):
    """Content of the TOML file of `subprocess:FILE`, a program that answers frame by frame.

    Attributes:
        images: ``raw``: one memory-mapped file; ``png``: two PNG files a frame.
        final: Whether it answers ``finalize``.
    """

    images: Literal["raw", "png"] = "raw"
    final: bool = False


def check_inside(path: str, what: str) -> None:
    """Refuse a path that may lie outside of a program's working folder.

    Raises:
        ValueError: It does.
    """
    parts = PurePosixPath(path)
    leaves = parts.is_absolute() or ".." in parts.parts or path.startswith("~")
    if leaves or not parts.parts or "\0" in path:
        raise ValueError(
            f"'{path}' is no file in the program's working folder, which is new for every run: write "
            f"a relative path for {what}, such as 'trajectory.txt', and let the command use it"
        )


P = TypeVar("P", bound=ProgramFile)


@dataclass(frozen=True)
class ProgramDocument(Generic[P]):
    """A program's TOML file, read and checked.

    Attributes:
        path: The file.
        program: What it says.
        declared: Its settings.
        templates: The texts of its templates, by the file that each makes.
        container: In what it runs; None without an image.
    """

    path: Path
    program: P
    declared: Declared
    templates: dict[str, str]
    container: Container | None

    @property
    def here(self) -> Path:
        """The folder of the TOML file."""
        return self.path.parent

    @property
    def template_files(self) -> list[Path]:
        """The templates."""
        return [self.here / template for template in self.program.templates.values()]

    def values(self, settings: Settings) -> dict[str, Scalar]:
        """The declared settings' values, by dotted name."""
        names = {name for name, _ in _named(self.declared)}
        return {name: value for name, value in flatten(settings).items() if name in names}

    def filled(self, settings: Settings, places: Mapping[str, str]) -> "FilledProgram":
        """Command, environment and files with values in the place of the placeholders.

        Args:
            settings: The tracker's.
            places: Paths and numbers by name of the placeholder; those without one stay as they are.
        """
        values = {name: text_of(value) for name, value in self.values(settings).items()}
        values |= {"here": str(self.here), "python": sys.executable, **places}
        program = self.program

        # words that name files beside the TOML file are these; what the run makes is not there yet
        made = {getattr(program, "output", ""), *program.templates}
        words: list[str] = []
        for word in program.command:
            filled = fill(word, values)
            beside = str(self.here / filled)
            looks_like_file = re.search(r"[./]", filled) and word not in made
            words.append(beside if looks_like_file and os.path.isfile(beside) else filled)  # noqa: PTH113 - it takes words that cannot be a path

        variables = {}
        for entry in program.environment:
            name, separator, value = entry.partition("=")
            if separator:
                variables[name] = fill(value, values)
        files = {target: fill(text, values) for target, text in self.templates.items()}
        return FilledProgram(words, variables, files)

    def launched(
        self,
        filled: "FilledProgram",
        variables: Mapping[str, str],
        *,
        work: Path,
        writable: Iterable[Path],
    ) -> tuple[list[str], dict[str, str]]:
        """The command that starts the program, in its container if it has one, and all environment variables of it.

        Args:
            filled: The program with its settings.
            variables: Environment variables of the run, such as the number of threads.
            work: Its working folder, which is there as long as the run.
            writable: Folders that it may write.
        """
        declared = self._handed_through
        environment = program_environment(declared) | {**variables, **filled.variables}
        if self.container is None:
            return filled.words, environment
        names = [*declared, *variables, *filled.variables]
        command = self.container.command(
            filled.words,
            work=work,
            writable=writable,
            variables=container_variables(environment, names),
            alive=work,
        )
        return command, environment

    @property
    def _handed_through(self) -> list[str]:
        """Names of the environment variables that the program gets as they are."""
        return [entry for entry in self.program.environment if "=" not in entry]

    @property
    def version(self) -> str:
        """The program's version with a digest of what the file says of how it runs."""
        decisive = self.program.decisive
        # what a program in a container looks up is not seen from outside
        if self.container is not None:
            decisive["image"] = self.container.identity()
            decisive["variables"] = {name: os.environ.get(name) for name in self._handed_through}
        return f"{self.program.version}+{digest(decisive)}"

    def files(self, settings: Settings) -> list[Path]:
        """The files whose content decides what the program does."""
        command = self.filled(settings, {}).words
        # of a container's command the files of this machine alone, which lie beside the TOML file
        if self.container is not None:
            command = [word for word in command if Path(word).is_relative_to(self.here)]
            command = ["", *command]
        named = []
        for value in self.values(settings).values():
            file = self.here / str(value)
            if isinstance(value, str) and value and os.path.isfile(file):  # noqa: PTH113 - as above
                named.append(file)
        own = [*self.template_files, *named]
        if self.container is not None:
            own += self.container.files
        return list(dict.fromkeys(files_of_command([*command, *map(str, own)], self.here)))

    def check(self, kind: str) -> None:
        """The program must be there.

        Args:
            kind: ``batch`` or ``subprocess``, for messages.

        Raises:
            SettingsError: It is not, or the container's engine or image is not.
        """
        if self.container is not None:
            self.container.check()
            return
        first = self.filled(settings_class(Settings, self.declared)(), {}).words[0]
        if _PLACEHOLDER.search(first) is None and shutil.which(first) is None:
            raise SettingsError(
                f"{kind}: cannot start '{first}': no such program", f"see command in {self.path}"
            )


@dataclass(frozen=True)
class FilledProgram:
    """A program's command and what it needs, with values in the place of the placeholders.

    Attributes:
        words: Program and arguments.
        variables: Environment variables that are set for it.
        files: Texts of the files in its working folder, by their relative path.
    """

    words: list[str]
    variables: dict[str, str]
    files: dict[str, str]

    def write(self, folder: Path) -> None:
        """Write the files into the working folder."""
        for target, text in self.files.items():
            path = folder / target
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")


def read_program(
    path: Path, kind: type[P], *, places: Iterable[str], needs_all: bool
) -> ProgramDocument[P]:
    """Read and check a program's TOML file with its templates.

    Args:
        path: The file.
        kind: What it describes.
        places: Placeholders that are no settings.
        needs_all: Whether each setting must have a placeholder: no request carries it.

    Raises:
        SettingsError: The file or a template is missing or damaged; a placeholder has no setting,
            or a setting no placeholder.
    """
    path = path.expanduser().absolute()
    program = validated(kind, read_toml(path, kind=SettingsError), str(path), SettingsError)
    declared = read_declared(program.settings, path.name)
    templates = {
        target: _template_text(path.parent / template, target)
        for target, template in program.templates.items()
    }
    container = None
    if program.image:
        container = Container(program.engine, program.image, program.gpu, path.parent)
    document = ProgramDocument(path, program, declared, templates, container)
    _check_names(document, set(places))
    _check_placeholders(document, set(places), needs_all=needs_all)
    return document


def _template_text(path: Path, target: str) -> str:
    """A template's text.

    Raises:
        SettingsError: It is missing or no text.
    """
    if not path.is_file():
        raise SettingsError(f"no template {path}, of which '{target}' is to be made")
    text = read_text(path, kind=SettingsError)
    if "\0" in text:
        raise SettingsError(f"the template {path} is not a text file: it holds null bytes")
    return text


def _check_names(document: ProgramDocument[Any], places: set[str]) -> None:
    """Refuse settings that are called like another placeholder.

    Args:
        document: The program's file.
        places: Names of placeholders that are no settings, such as ``camera.fx``.
    """
    taken = {place.partition(".")[0] for place in places}
    for name in document.declared:
        if name in taken:
            raise SettingsError(
                f"{document.path.name}: a setting cannot be called '{name}', which is a placeholder already",
                f"call it my_{name}, for example",
            )


def _check_placeholders(
    document: ProgramDocument[Any], places: set[str], *, needs_all: bool
) -> None:
    """Refuse placeholders that stand for nothing, and settings that reach no program."""
    # all texts in which placeholders may stand
    program = document.program
    texts = {"command": " ".join(program.command), "environment": " ".join(program.environment)}
    for target, text in document.templates.items():
        texts[f"template {program.templates[target]}"] = text

    settings = {name for name, _ in _named(document.declared)}
    used: set[str] = set()
    for where, text in texts.items():
        names = placeholders(text)
        for unknown in sorted(names - settings - places):
            close = did_you_mean(unknown, sorted(settings | places))
            escape = f"write {{{{{unknown}}}}} for the text {{{unknown}}}"
            raise SettingsError(
                f"{document.path.name}: {{{unknown}}} in {where} is neither a setting nor a path",
                f"{close}; {escape}" if close else escape,
            )
        used |= names

    # a setting that no text names would have no effect
    unused = sorted(settings - used)
    if unused and needs_all:
        names_shown = ", ".join(unused)
        raise SettingsError(
            f"{document.path.name}: no {{{unused[0]}}} in command, environment or templates: "
            f"the program would never know of {names_shown}",
            "put it where the program reads it, or leave the setting out",
        )


def _named(declared: Declared, prefix: str = "") -> Iterable[tuple[str, ProgramSetting]]:
    """The declared settings by dotted name."""
    for name, entry in declared.items():
        if isinstance(entry, ProgramSetting):
            yield f"{prefix}{name}", entry
        else:
            yield from _named(entry, f"{prefix}{name}.")


# -- placeholders ----------------------------------------------------------------------------------


def placeholders(text: str) -> set[str]:
    """Names of the placeholders in a text.

    Example:
        >>> sorted(placeholders("{features} ${HOME} {{left}} {a: 1} {camera.fx}"))
        ['camera.fx', 'features']
    """
    return {match[2] for match in _PLACEHOLDER.finditer(text) if match[2]}


def fill(text: str, values: Mapping[str, str]) -> str:
    """A text with values in the place of its placeholders; those without a value stay.

    Example:
        >>> fill("n: {n}  # ${HOME} {{n}} {a: 1}", {"n": "5"})
        'n: 5  # ${HOME} {n} {a: 1}'
    """

    def replacement(match: re.Match[str]) -> str:
        if match[1]:
            return f"{{{match[1]}}}"
        return values.get(match[2], match[0])

    return _PLACEHOLDER.sub(replacement, text)


def text_of(value: Scalar) -> str:
    """A value as command lines and configurations take it: ``true``, ``1.0``, ``1.0e-07``."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return real_text(value) if isinstance(value, float) else str(value)


def real_text(value: float) -> str:
    """A number that OpenCV's parser reads as real: always with a point, as ``1.0`` or ``1.0e-07``."""
    mantissa, exponent, power = repr(value).partition("e")
    return (mantissa if "." in mantissa else f"{mantissa}.0") + exponent + power


def camera_values(camera: Camera, fps: float) -> dict[str, str]:
    """The numbers of a camera by placeholder."""
    whole = (camera.width, camera.height, max(1, round(fps)))
    reals = (
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        *camera.distortion,
        camera.baseline_m,
        camera.fx * camera.baseline_m,
        camera.written_depth_factor,
    )
    texts = [*map(str, whole), *(real_text(float(number)) for number in reals)]
    return dict(zip(CAMERA_NAMES, texts, strict=True))


# -- the trackers' settings, and what their specs say of a file --------------------------------------


class BatchSettings(Settings):
    """Settings of `batch:FILE`, beside those that the file declares."""

    program: str = names(
        "",
        "description",
        meaning="TOML file that describes the program, see docs/how-to/program.md",
    )
    timeout_s: float = Field(3600.0, gt=0, description="seconds that the program may take")

    def document(self) -> ProgramDocument[BatchProgram]:
        """The program's file.

        Raises:
            SettingsError: It is missing or damaged.
        """
        refuse_without_file(self, BatchSettings, self.program, "batch")
        return read_batch(Path(self.program))

    def verify(self) -> None:
        """The file must be sound, and the program there."""
        self.document().check("batch")


class ServedSettings(ProgramSettings):
    """Settings of `subprocess:FILE.toml`, beside those that the file declares."""

    command: str = names(
        "",
        "description",
        meaning="TOML file that describes the program, see docs/how-to/program.md",
    )

    def document(self) -> ProgramDocument[ServedProgram]:
        """The program's file.

        Raises:
            SettingsError: No file was named (plain ``subprocess``), or it is missing or damaged.
        """
        # a named file gives the settings a class of their own; this class itself means that none was named
        refuse_without_file(self, ServedSettings, self.command, "subprocess")
        return read_served(Path(self.command))

    def verify(self) -> None:
        """The file must be sound, and the program there."""
        self.document().check("subprocess")


def refuse_without_file(settings: Settings, base: type[Settings], file: str, kind: str) -> None:
    """Refuse settings that know nothing of their file: it was not named behind the tracker's id.

    Raises:
        SettingsError: They do not.
    """
    if type(settings) is base:
        shown = file.strip() or "FILE.toml"
        raise SettingsError(
            f"{kind} needs a file that describes the program", f"write {kind}:{shown}"
        )


def read_batch(path: Path) -> ProgramDocument[BatchProgram]:
    """The file of a program for whole sequences.

    Raises:
        SettingsError: It is missing or damaged.
    """
    places = (*COMMON_NAMES, *BATCH_NAMES)
    return read_program(path, BatchProgram, places=places, needs_all=True)


def read_served(path: Path) -> ProgramDocument[ServedProgram]:
    """The file of a program that answers frame by frame; its ``reset`` request carries the settings.

    Raises:
        SettingsError: It is missing or damaged.
    """
    return read_program(path, ServedProgram, places=COMMON_NAMES, needs_all=False)


def describe_batch(value: str) -> dict[str, Any]:
    """Read the file of `batch:FILE` into fields of its `TrackerSpec`.

    Raises:
        SettingsError: It is damaged.
    """
    return _described(read_batch(Path(value)), BatchSettings)


def describe_served(value: str) -> dict[str, Any]:
    """Read the file of `subprocess:FILE.toml` into fields of its `TrackerSpec`; none for `subprocess:COMMAND`.

    Raises:
        SettingsError: It is damaged.
    """
    if not value.endswith(".toml") or (" " in value and not os.path.isfile(value)):  # noqa: PTH113 - it takes words that cannot be a path
        return {}
    here = __name__.rpartition(".")[0]
    fields = {
        "entry_point": f"{here}.subprocess_tracker:build_described",
        "files": f"{here}.program_file:files",
        "summary": "A program that a TOML file describes, over JSON lines.",
    }
    return fields | _described(read_served(Path(value)), ServedSettings)


def _described(document: ProgramDocument[Any], base: type[Settings]) -> dict[str, Any]:
    """Fields of a `TrackerSpec` from a program's file; its presets are checked."""
    program = document.program
    try:
        settings = settings_class(base, document.declared)
        for name, values in program.presets.items():
            _check_preset(settings, name, values)
    except SettingsError as error:
        raise SettingsError(f"{document.path.name}: {error.args[0]}", error.hint) from None
    return {
        "license": program.license,
        "citation": program.citation,
        "sensors": program.sensors,
        "label": program.name,
        "version": document.version,
        "settings": settings,
        "presets": program.presets,
    }


def _check_preset(settings: type[Settings], name: str, values: Mapping[str, Any]) -> None:
    """Refuse a preset with unknown settings or unfit values."""
    available = field_names(settings)
    for setting in values:
        if setting not in available:
            raise SettingsError(
                f"preset '{name}' sets an unknown '{setting}'", did_you_mean(setting, available)
            )
    try:
        apply_overrides(settings(), values)
    except DynslamError as error:
        raise SettingsError(f"preset '{name}': {error.args[0]}") from None


def files(settings: "BatchSettings | ServedSettings") -> list[Path]:
    """The files that decide what the program does: those of its command, and its templates."""
    return settings.document().files(settings)
