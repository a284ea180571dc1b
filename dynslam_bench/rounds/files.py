"""The files of a round: ``round.json``, ``entries/NAME.json``, ``reveal.json``, ``results/RUNNER/``.

Each names what it builds on by a SHA-256, so that a file that was changed afterwards is found.
"""

import hashlib
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field, field_validator

from dynslam_bench.core import DynslamError, RunError, did_you_mean, file_sha256, write_atomic
from dynslam_bench.core.fingerprint import Machine
from dynslam_bench.core.records import Name, Record, schema
from dynslam_bench.evaluation import get_protocol
from dynslam_bench.runs.record import Status
from dynslam_bench.runs.spec import RunSpec
from dynslam_bench.sequences.synthetic import parse_synthetic_id
from dynslam_bench.sequences.synthetic.ids import VARIANTS
from dynslam_bench.sequences.synthetic.sealed import ROUND_NAME, parse_salt, sealed_scene
from dynslam_bench.sequences.synthetic.settings import MAX_FRAMES, RENDERER_VERSION

ROUND_FILE = "round.json"
"""File that the organiser publishes first."""
REVEAL_FILE = "reveal.json"
"""File that the organiser publishes after the deadline."""
RESULTS_FILE = "results.json"
"""Says which rows a runner's bank holds."""
ROUND_SCHEMA = 1
"""Version of the fields of all files of a round."""
MOST_SCENES = 10_000
"""Scenes of a family at most."""

Utc = Annotated[str, AfterValidator(lambda text: utc(text))]
"""A time of ISO 8601 in UTC, to the second."""
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class RoundRecord(Record):
    """Base of the files of a round."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: int = schema(ROUND_SCHEMA)


class Round(RoundRecord):
    """The round, as it is published before anybody enters.

    Attributes:
        name: Its name, part of every scene's number.
        families: Names of rendered sequences, e.g. ``walking_xyz``.
        scenes: Sealed scenes of each family.
        frames: Frames of each scene.
        protocol: How errors are computed.
        protocol_digest: Digest of the protocol.
        deadline: UTC, ISO 8601; empty where entries are received until the reveal.
        rules: What else holds, in words.
        tolerance: A row counts as reproduced where the two errors differ by no more than this share.
        salt_sha256: SHA-256 of the salt's bytes: the commitment.
        renderer: Versions of the renderer and of each family.
        probes: Ids of public scenes to the digests of their bits on the organiser's machine.
    """

    name: str = Field(pattern=f"^{ROUND_NAME}$")
    families: list[str] = Field(min_length=1)
    scenes: int = Field(ge=1, le=MOST_SCENES)
    frames: int = Field(ge=2, le=MAX_FRAMES)
    protocol: str
    protocol_digest: str
    deadline: str = ""
    rules: str = ""
    tolerance: float = Field(0.1, ge=0, le=1)
    salt_sha256: Sha256
    renderer: dict[str, int]
    probes: dict[str, Sha256]

    @field_validator("families")
    @classmethod
    def _are_known(cls, families: list[str]) -> list[str]:
        for family in families:
            if family not in VARIANTS:
                raise ValueError(f"unknown family '{family}' ({did_you_mean(family, VARIANTS)})")
        return list(dict.fromkeys(families))

    @field_validator("deadline")
    @classmethod
    def _is_a_time(cls, deadline: str) -> str:
        return utc(deadline) if deadline else ""

    def sequences(self, salt: bytes) -> list[str]:
        """Ids of the round's scenes, family by family."""
        return [
            f"synthetic/{family}?scene={sealed_scene(salt, self.name, family, index)}&frames={self.frames}"
            for family in self.families
            for index in range(self.scenes)
        ]

    def label_of(self, sequence: str, salt: bytes) -> str:
        """Name of a scene in tables: ``walking_xyz 3``; its id where it is none of the round's."""
        ids = self.sequences(salt)
        if sequence not in ids:
            return sequence
        at = ids.index(sequence)
        return f"{self.families[at // self.scenes]} {at % self.scenes}"

    def check_here(self) -> None:
        """Check that this installation renders and evaluates as the round says.

        Raises:
            RunError: The renderer, a family or the protocol has another version.
        """
        for part, version in renderer_versions(self.families).items():
            stated = self.renderer.get(part)
            if stated != version:
                what = "the renderer" if part == "renderer" else f"family '{part}'"
                raise RunError(
                    f"round {self.name} was made with version {stated} of {what}, here it is {version}",
                    "install the release of dynslam-bench that the round was made with",
                )
        digest_here = get_protocol(self.protocol).digest()
        if digest_here != self.protocol_digest:
            raise RunError(
                f"protocol '{self.protocol}' has the digest {digest_here} here, "
                f"round {self.name} has {self.protocol_digest}",
                "install the release of dynslam-bench that the round was made with",
            )


class Trial(Record):
    """A run on a public scene that an entry was made with.

    Attributes:
        sequence: The scene.
        run_id: The run.
        status: How it ended.
        ate_m: Its error, metres; None without one.
        coverage: Share of the frames with a pose.
    """

    sequence: str
    run_id: str
    status: Status
    ate_m: float | None = None
    coverage: float | None = None


class Program(Record):
    """The program of an entry: what must not change between its freezing and its runs.

    Paths below the round's folder count from there. Versions of numpy and the like are no part of
    it: they differ from machine to machine.

    Attributes:
        settings: All settings by dotted name.
        code: Digest of the code of each part, of the tracker's version and of packages that it needs.
        weights: Digests of the networks.
        files: Digests of the entrant's own files, in ``entries/NAME`` or beside the plug-in.
    """

    settings: dict[str, Any]
    code: dict[str, str]
    weights: dict[str, str] = Field(default_factory=dict)
    files: dict[str, str] = Field(default_factory=dict)


class Entry(RoundRecord):
    """A frozen tracker.

    Attributes:
        name: Name of the entry, also that of its file.
        round_sha256: SHA-256 of ``round.json``.
        protocol: Protocol of the round.
        tracker: The tracker as ``run`` takes it, paths from the round's folder.
        overrides: Settings that were asked for.
        program: What must not change.
        folder: SHA-256 of every file in ``entries/NAME``, by its path from there.
        checks: Names of the conformance checks that it passed.
        trial: Its run on a public scene.
        entered: UTC, ISO 8601, as the entrant's clock says.
        machine: The computer on which it was entered.
        versions: Versions of Python and of the packages that matter.
    """

    name: Name
    round_sha256: Sha256
    protocol: str
    tracker: str
    overrides: dict[str, Any] = Field(default_factory=dict)
    program: Program
    folder: dict[str, Sha256] = Field(default_factory=dict)
    checks: list[str]
    trial: Trial
    entered: Utc
    machine: Machine
    versions: dict[str, str]

    def spec(self, sequence: str) -> RunSpec:
        """The run of this entry on a sequence; its working folder is the round's."""
        return RunSpec(
            tracker=self.tracker, sequence=sequence, settings=self.overrides, label=self.name
        )


class Reveal(RoundRecord):
    """The end of a round: the salt, and the entries that were received in time.

    Attributes:
        round_sha256: SHA-256 of ``round.json``.
        salt: The salt, 64 hexadecimal digits.
        entries: SHA-256 of each entry's file, by the entry's name.
        revealed: UTC, ISO 8601.
    """

    round_sha256: Sha256
    salt: str
    entries: dict[Name, Sha256]
    revealed: str


class Row(Record):
    """One run of a bank: which entry on which scene."""

    entry: Name
    sequence: str
    run_id: str


class Results(RoundRecord):
    """Results of a runner: describes the bank beside it.

    Attributes:
        by: Name of the runner.
        round_sha256: SHA-256 of ``round.json``.
        reveal_sha256: SHA-256 of ``reveal.json``.
        scenes: Digest of the bits of each scene as they were rendered there, by its id.
        rows: The runs.
        sample: Whether all rows are a sample that a verifier has drawn: then scenes may be missing.
        network: ``none`` where no entry could reach a network in any row, else ``open``.
        made: UTC, ISO 8601.
        machine: The computer; that of the last rows where `mixed`.
        versions: Versions of Python and of the packages that matter; those of the last rows where
            `mixed`.
        mixed: Whether earlier rows were made on another computer or with other versions; the record
            of each run says which.
    """

    by: Name
    round_sha256: Sha256
    reveal_sha256: Sha256
    scenes: dict[str, Sha256]
    rows: list[Row]
    sample: bool = False
    network: Literal["none", "open"]
    made: str
    machine: Machine
    versions: dict[str, str]
    mixed: bool = False


@dataclass(frozen=True, eq=False)
class RoundFolder:
    """A round's folder.

    Attributes:
        root: The folder.
    """

    root: Path

    @cached_property
    def round(self) -> Round:
        """The round.

        Raises:
            RunError: There is none, or its file is damaged.
        """
        file = self.root / ROUND_FILE
        if not file.is_file():
            raise RunError(
                f"{self.root} is no round: it has no {ROUND_FILE}",
                "make one with: dynslam-bench round new FOLDER --name NAME",
            )
        return Round.read(file)

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of the round's file."""
        return file_sha256(self.root / ROUND_FILE)

    @property
    def is_revealed(self) -> bool:
        """Whether the salt is published."""
        return (self.root / REVEAL_FILE).is_file()

    @cached_property
    def reveal(self) -> Reveal:
        """The reveal, checked against the commitment.

        Raises:
            RunError: There is none yet, it is of another round, or its salt is another one.
        """
        if not self.is_revealed:
            raise RunError(
                f"round {self.round.name} is not revealed yet: there is no {self.root / REVEAL_FILE}",
                "the organiser publishes the salt after the deadline: dynslam-bench round reveal",
            )
        revealed = Reveal.read(self.root / REVEAL_FILE)
        self._check_round(revealed.round_sha256, REVEAL_FILE)
        check_salt(self.round, parse_salt(revealed.salt), REVEAL_FILE)
        return revealed

    @property
    def reveal_sha256(self) -> str:
        """SHA-256 of the reveal's file."""
        return file_sha256(self.root / REVEAL_FILE)

    @property
    def salt(self) -> bytes:
        """The published salt."""
        return parse_salt(self.reveal.salt)

    @property
    def sequences(self) -> list[str]:
        """Ids of the sealed scenes."""
        return self.round.sequences(self.salt)

    def entry_file(self, name: str) -> Path:
        """Path of an entry."""
        return self.root / "entries" / f"{name}.json"

    def entry_names(self) -> list[str]:
        """Names of the entries that lie in the folder, sorted."""
        return sorted(file.stem for file in (self.root / "entries").glob("*.json"))

    def read_entry(self, name: str) -> Entry:
        """An entry, checked against the round.

        Raises:
            RunError: It is damaged, named otherwise, or of another round or protocol.
        """
        file = self.entry_file(name)
        entry = Entry.read(file)
        if entry.name != name:
            raise RunError(f"{file} names itself '{entry.name}'", "its file has the entry's name")
        if entry.protocol != self.round.protocol:
            raise RunError(
                f"entry '{name}' is for protocol '{entry.protocol}', "
                f"round {self.round.name} has '{self.round.protocol}'",
                "enter again with this round.json",
            )
        self._check_round(entry.round_sha256, f"entry '{name}'")
        return entry

    def late_entries(self) -> list[str]:
        """Names of the entries that lie in the folder and that the reveal does not list."""
        return [name for name in self.entry_names() if name not in self.reveal.entries]

    def late_words(self, name: str) -> str:
        """Why an entry that the reveal does not list is not run."""
        return f"entry '{name}' is not listed in {REVEAL_FILE}"

    def received_entry(self, name: str) -> Entry:
        """An entry that was received in time, unchanged since.

        Raises:
            RunError: The reveal does not list it, it is missing, or it was changed.
        """
        stated = self.reveal.entries.get(name)
        if stated is None:
            raise RunError(
                self.late_words(name), f"listed: {', '.join(self.reveal.entries) or 'none'}"
            )
        file = self.entry_file(name)
        if not file.is_file():
            raise RunError(
                f"entry '{name}' is missing: there is no {file}", "get it from the entrant"
            )
        actual = file_sha256(file)
        if actual != stated:
            raise RunError(
                f"entry '{name}' was changed after the reveal: its SHA-256 is {actual[:16]}, listed is {stated[:16]}",
                "restore the file",
            )
        return self.read_entry(name)

    def runners(self) -> list[str]:
        """Names of those who have published results, sorted."""
        return sorted(
            file.parent.name for file in (self.root / "results").glob(f"*/{RESULTS_FILE}")
        )

    def bank(self, by: str) -> Path:
        """The bank of a runner."""
        return self.root / "results" / by

    def read_results(self, by: str) -> Results:
        """The description of a runner's bank.

        Raises:
            RunError: There is none, or it is of another round, reveal or runner.
        """
        file = self.bank(by) / RESULTS_FILE
        if not file.is_file():
            raise RunError(
                f"there are no results of '{by}'",
                did_you_mean(by, self.runners()) or "run it first",
            )
        results = Results.read(file)
        self._check_round(results.round_sha256, str(file))
        if results.by != by:
            raise RunError(f"{file} names '{results.by}' as its runner", "its folder has that name")
        if results.reveal_sha256 != self.reveal_sha256:
            raise RunError(
                f"{file} is of another {REVEAL_FILE}: its SHA-256 was {results.reveal_sha256[:16]}, "
                f"here it is {self.reveal_sha256[:16]}",
                f"restore the {REVEAL_FILE} that was published",
            )
        return results

    def _check_round(self, stated: str, what: str) -> None:
        """Refuse a file that builds on another ``round.json``."""
        if stated != self.sha256:
            raise RunError(
                f"{what} is of another round: its {ROUND_FILE} has the SHA-256 {stated[:16]}, "
                f"this one has {self.sha256[:16]}",
                f"restore the {ROUND_FILE} that was published",
            )


def open_round(folder: str | Path) -> RoundFolder:
    """The round in a folder.

    Raises:
        RunError: There is none, or its file is damaged.
    """
    opened = RoundFolder(Path(folder).expanduser().absolute())
    try:
        _ = opened.round
    except RunError:
        raise
    except DynslamError as error:
        raise RunError(error.args[0], error.hint) from error
    return opened


def reveal(folder: str | Path, salt_file: str | Path, *, now: datetime | None = None) -> Reveal:
    """Publish the salt and the digests of the entries received.

    Args:
        folder: The round's folder.
        salt_file: Holds the salt.
        now: The time; that of the clock by default.

    Raises:
        RunError: The deadline is still to come, the salt is another one, the round is revealed
            already, or an entry does not fit.
    """
    opened = open_round(folder)
    now = now or datetime.now(timezone.utc)
    if opened.is_revealed:
        raise RunError(
            f"round {opened.round.name} is revealed already, at {opened.reveal.revealed}",
            "nothing is changed",
        )
    deadline = opened.round.deadline
    if deadline and now < datetime.fromisoformat(deadline):
        raise RunError(
            f"entries are received until {deadline}, it is {stamp(now)}",
            "reveal after the deadline",
        )
    salt = read_salt(salt_file)
    check_salt(opened.round, salt, str(salt_file))
    # an entry that does not fit the round is refused here, by name
    for name in opened.entry_names():
        entered = opened.read_entry(name).entered
        if deadline and entered >= deadline:
            raise RunError(
                f"entry '{name}' was entered at {entered}, the deadline was {deadline}: it is late",
                f"remove {opened.entry_file(name)}",
            )
    entries = {name: file_sha256(opened.entry_file(name)) for name in opened.entry_names()}
    made = Reveal(round_sha256=opened.sha256, salt=salt.hex(), entries=entries, revealed=stamp(now))
    write_atomic(opened.root / REVEAL_FILE, made.to_json())
    return made


def read_salt(file: str | Path) -> bytes:
    """The salt in a file.

    Raises:
        RunError: It cannot be read.
        DynslamError: It is no salt.
    """
    path = Path(file).expanduser()
    if not path.is_file():
        raise RunError(
            f"there is no salt {path}", "name the file that `round new` wrote: --salt FILE"
        )
    return parse_salt(path.read_text(encoding="utf-8", errors="replace"))


def check_salt(of: Round, salt: bytes, where: str) -> None:
    """Check a salt against the commitment.

    Raises:
        RunError: It has another SHA-256.
    """
    actual = hashlib.sha256(salt).hexdigest()
    if actual != of.salt_sha256:
        raise RunError(
            f"the salt in {where} has the SHA-256 {actual[:16]}, {ROUND_FILE} committed to {of.salt_sha256[:16]}: "
            "it is another salt",
            "only the salt drawn by `round new` fits",
        )


def renderer_versions(families: list[str]) -> dict[str, int]:
    """Versions of the renderer, by ``renderer``, and of families, by their names."""
    of_families = {
        family: parse_synthetic_id(f"synthetic/{family}").variant.version for family in families
    }
    return {"renderer": RENDERER_VERSION} | of_families


def utc(text: str) -> str:
    """A time of ISO 8601 in UTC, to the second.

    Raises:
        ValueError: It is none, or has no time zone.
    """
    try:
        # Python 3.10 does not read the Z
        time = datetime.fromisoformat(text.replace("Z", "+00:00"))
    except ValueError:
        raise ValueError(f"'{text}' is no time: write 2026-12-24T12:00Z") from None
    if time.tzinfo is None:
        raise ValueError(f"'{text}' has no time zone: write {text}Z for UTC")
    return stamp(time)


def stamp(time: datetime) -> str:
    """A time as text: UTC, ISO 8601, to the second."""
    return time.astimezone(timezone.utc).isoformat(timespec="seconds")
