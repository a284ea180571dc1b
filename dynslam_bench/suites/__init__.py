"""Benchmark suites, as TOML files: which trackers run on which sequences, with which repeats."""

from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field

from dynslam_bench.core import RunError, did_you_mean, parse_toml, read_text
from dynslam_bench.core.records import Record, validated
from dynslam_bench.core.settings import field_names
from dynslam_bench.runs.spec import Limits, RunSpec
from dynslam_bench.trackers import TRACKERS

__all__ = ["Suite", "Variant", "load_suite", "suite_names"]

Offset = Annotated[int, Field(ge=0)]


class Variant(Record):
    """One way to run everything in a suite.

    Attributes:
        name: Shown in tables; empty for the plain variant.
        degrade: Strengths of `DegradeFrames`.
        drop_share: Share of the frames dropped at random.
        realtime: Whether frames are dropped while the tracker is busy.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = ""
    degrade: dict[str, float] = Field(default_factory=dict)
    drop_share: float = Field(default=0.0, ge=0, lt=1)
    realtime: bool = False


class Row(Record):
    """A tracker once more, with settings of its own: a reference beside the systems.

    Attributes:
        tracker: One of the suite's trackers.
        settings: What is different from its other row.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    tracker: str
    settings: dict[str, Any] = Field(min_length=1)


class Suite(Record):
    """A benchmark suite: every tracker on every sequence, with every seed, in every variant.

    Attributes:
        name: Its name.
        title: One line for reports.
        description: Purpose of the suite.
        trackers: Ids, ``id:value``, ``module:Attr`` or ``file.py:Attr``.
        optional: Trackers that take part only where the packages they need are installed.
        sequences: Ids or folders.
        seeds: Seeds.
        offsets: Start offsets: so many leading frames are left out; repeats, like seeds (see
            `RunSpec.offset`).
        frames: Part of every sequence, ``[start, stop]``; without it all.
        stride: Take every so many frames.
        threads: Threads of a run.
        cache: Whether features and masks that trackers share are computed once (see
            `RunSpec.cache`).
        settings: Overrides for every tracker that has the setting.
        tracker_settings: Overrides by tracker.
        rows: Further rows: trackers of the suite once more, with other settings.
        variants: Ways to run everything.
        limits: What a run may take.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    title: str = ""
    description: str = ""
    trackers: tuple[str, ...] = Field(min_length=1)
    optional: tuple[str, ...] = ()
    sequences: tuple[str, ...] = Field(min_length=1)
    seeds: tuple[int, ...] = Field(default=(0,), min_length=1)
    offsets: tuple[Offset, ...] = Field(default=(0,), min_length=1)
    frames: tuple[int, int | None] | None = None
    stride: int = Field(default=1, ge=1)
    threads: int = Field(default=1, ge=1, le=1024)
    cache: bool = False
    settings: dict[str, Any] = Field(default_factory=dict)
    tracker_settings: dict[str, dict[str, Any]] = Field(default_factory=dict)
    rows: tuple[Row, ...] = ()
    variants: tuple[Variant, ...] = Field(default=(Variant(),), min_length=1)
    limits: Limits = Limits()

    def specs(
        self,
        *,
        data_root: str | Path | None = None,
        device: str = "auto",
        threads: int | None = None,
        trackers: tuple[str, ...] = (),
        seeds: tuple[int, ...] = (),
        offsets: tuple[int, ...] = (),
        frames: tuple[int, int | None] | None = None,
        snapshots: bool = False,
    ) -> Iterator[RunSpec]:
        """The runs of the suite, sequence by sequence so that rendered frames are shared while they are fresh.

        Args:
            data_root: Folder of the recorded sequences.
            device: Device of all runs.
            threads: Threads of a run in place of the suite's.
            trackers: Only these trackers of the suite, or others in place of them.
            seeds: Seeds in place of the suite's.
            offsets: Start offsets in place of the suite's.
            frames: Frames in place of the suite's, ``(start, stop)``.
            snapshots: See `RunSpec.snapshots`.

        Raises:
            PluginError: A tracker is not known (with a did-you-mean).
            RunError: A tracker is given settings but is no part of the suite.
        """
        shared: dict[str, Any] = {
            "frames": frames or self.frames,
            "stride": self.stride,
            "device": device,
            "snapshots": snapshots,
            "threads": threads or self.threads,
            "cache": self.cache,
            "limits": self.limits,
            "data_root": None if data_root is None else str(data_root),
        }
        entries = self._entries(trackers)
        return (
            RunSpec(
                tracker=tracker,
                sequence=sequence,
                seed=seed,
                offset=offset,
                settings=settings,
                degrade=variant.degrade,
                drop_share=variant.drop_share,
                realtime=variant.realtime,
                **shared,
            )
            for sequence in self.sequences
            for variant in self.variants
            for tracker, settings in entries
            for seed in seeds or self.seeds
            for offset in offsets or self.offsets
        )

    def _entries(self, trackers: tuple[str, ...]) -> list[tuple[str, dict[str, Any]]]:
        """The trackers with their settings, row by row; `trackers` in place of the suite's if there are any."""
        # the suite's trackers, optional ones where they can run
        installed = [name for name in self.optional if not TRACKERS.get(name).missing()]
        chosen = trackers or (*self.trackers, *installed)

        # settings may be given to the suite's trackers only
        members = {*self.trackers, *self.optional}
        field_sets = {
            name: set(field_names(TRACKERS.get(name).settings)) for name in {*chosen, *members}
        }
        configured = {*self.tracker_settings, *(row.tracker for row in self.rows)}
        strangers = sorted(configured - members)
        if strangers:
            raise RunError(
                f"suite '{self.name}' has settings for '{strangers[0]}', which is none of its trackers",
                did_you_mean(strangers[0], members),
            )

        # a setting for all trackers must be a field of one of them
        settable = set().union(*field_sets.values())
        unknown = sorted(self.settings.keys() - settable)
        if unknown:
            raise RunError(
                f"suite '{self.name}' sets '{unknown[0]}', which none of its trackers has",
                did_you_mean(unknown[0], settable),
            )

        # settings of all trackers, then of one tracker, then of one row: the later ones win
        rows: list[tuple[str, dict[str, Any]]] = [(tracker, {}) for tracker in chosen]
        rows += [(row.tracker, row.settings) for row in self.rows if row.tracker in chosen]
        entries = []
        for tracker, of_row in rows:
            shared = {
                name: value for name, value in self.settings.items() if name in field_sets[tracker]
            }
            entries.append((tracker, shared | self.tracker_settings.get(tracker, {}) | of_row))
        return entries


def suite_names() -> list[str]:
    """Names of the suites that come with the package."""
    names = [entry.name for entry in files(__package__).iterdir()]
    return sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml"))


def load_suite(name: str | Path) -> Suite:
    """A suite by its name, or from a TOML file.

    Raises:
        RunError: There is no such suite, the file cannot be read or is no TOML, or it does not
            describe a suite (with the first fault).
        PluginError: One of its trackers is not known.
    """
    # one that comes with the package, or a file
    path = Path(name).expanduser()
    if str(name) in suite_names():
        text = files(__package__).joinpath(f"{name}.toml").read_text(encoding="utf-8")
        where = f"{name}.toml"
    elif path.suffix.lower() == ".toml":
        text = read_text(path, kind=RunError)
        where = str(path)
    else:
        raise RunError(
            f"unknown suite '{name}'",
            f"{did_you_mean(str(name), suite_names())} Or name a .toml file",
        )

    document = parse_toml(text, where, kind=RunError)
    document.setdefault("name", Path(where).stem)
    suite = validated(Suite, document, where, RunError)
    # all trackers must be known
    for tracker in (*suite.trackers, *suite.optional):
        TRACKERS.get(tracker)
    return suite
