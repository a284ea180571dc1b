"""A bank of trajectories: a results folder of text files alone, with checksums, that is exchanged and scored again.

It holds ``runs/<run_id>/`` with ``run.json`` and the trajectories, ``sequences/<part>/`` with
stamps and ground truth, ``bank.json`` with its protocol, ``marks/`` of those who have run a row
again (`bank_files`), and ``SHA256SUMS`` of them all, in the format of ``sha256sum -c``. Whatever
reads a results folder reads a bank.

Runs are added in four steps: an empty file `UNFINISHED` is written, the runs are copied, each of
which appears whole or not at all, the checksums are written, the empty file is removed. Where a
process was killed in between, the file says that there may be runs without checksums, and the next
one that adds goes on from there.
"""

import re
import shutil
import subprocess
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

from pydantic import ConfigDict, Field

from dynslam_bench.core import (
    DynslamError,
    InfrastructureError,
    RunError,
    TemporaryFolder,
    compare_sums,
    exclusive_lock,
    file_sha256,
    is_temporary,
    read_lines,
    read_toml,
    replace_folder,
    translate_errors,
    write_atomic,
)
from dynslam_bench.core.download import download
from dynslam_bench.core.errors import hide_folder_in_messages
from dynslam_bench.core.records import Record, digest, validated
from dynslam_bench.evaluation import get_protocol
from dynslam_bench.runs.bank_files import (
    DESCRIPTION_FILE,
    MARKS_FOLDER,
    BankDescription,
    Mark,
    mark_file,
    new_description,
    read_description,
    read_marks,
)
from dynslam_bench.runs.copying import merge
from dynslam_bench.runs.exchange.transfer import import_trajectory
from dynslam_bench.runs.layout import (
    COVARIANCES,
    FINAL,
    ONLINE,
    RUN_FILE,
    STAMPS,
    TrajectoryKind,
    Unreadable,
)
from dynslam_bench.runs.record import RunRecord, run_id_of
from dynslam_bench.runs.store import DEFAULT_PROTOCOL, Merged, RunStore, open_store
from dynslam_bench.sequences.synthetic import parse_synthetic_id
from dynslam_bench.sequences.synthetic.ids import probe_id

SUMS = "SHA256SUMS"
"""The list of checksums, in the format of ``sha256sum -c``."""
UNFINISHED = ".unfinished"
"""An empty file that is there while runs are added."""
_CONTENT_FOLDERS = ("runs", "sequences", MARKS_FOLDER)
"""Folders whose files are listed with their checksums."""
_ARCHIVE = re.compile(r"https?://.*\.(?:zip|tgz|tar|tar\.gz)(?:\?.*)?")
"""The address of an archive, which is downloaded."""
_ADDRESS = re.compile(r"[a-z+]+://.*|(?:[\w.-]+@)?[\w.-]+:.+")
"""An address: a URL, or a place on another machine as ssh and git name it."""


class Bank(RunStore):
    """A results folder that takes of a run what scores are computed from, and nothing of the machine that made it."""

    def copy_from(self, other: RunStore, record: RunRecord) -> RunRecord:
        """Copy the record, trajectories and covariances of a run, and the stamps and ground truth of its sequence.

        Raises:
            InfrastructureError: It cannot be written.
            RunError: It was removed or changed while it was copied.
        """
        # the sequence's stamps and ground truth, shared by its runs
        self.copy_stamps_and_truth(other, record)
        with self.work_folder(record.run_id) as work:
            # the run's own files, read while nobody changes them
            with self.copying(other, record):
                for name in (ONLINE, FINAL, COVARIANCES):
                    file = other.folder(record.run_id) / name
                    if file.is_file():
                        shutil.copyfile(file, work / name)
                (work / RUN_FILE).write_text(record.public().to_json(), encoding="utf-8")
            self.check_copy(work, record)
            with translate_errors(
                InfrastructureError,
                f"cannot write {self.folder(record.run_id)}",
                "check the free space",
            ):
                replace_folder(work, self.folder(record.run_id))
        return record

    def link_latest(self, run_id: str) -> None:
        """A bank has no link to its newest run."""

    def files(self) -> list[str]:
        """Names of the files that its checksums are of, links and hidden ones included, relative to it.

        What a killed process left unfinished is not among them.
        """
        names = []
        for folder in _CONTENT_FOLDERS:
            for path in (self.root / folder).rglob("*"):
                inside = path.relative_to(self.root)
                is_unfinished = any(is_temporary(Path(name)) for name in inside.parts)
                if not is_unfinished and (path.is_symlink() or path.is_file()):
                    names.append(inside.as_posix())
        if (self.root / DESCRIPTION_FILE).exists():
            names.append(DESCRIPTION_FILE)
        return sorted(names)


class StatedTrajectory(Record):
    """A table ``[[trajectory]]`` of a manifest.

    Attributes:
        file: A trajectory in TUM's format: an address, or a path from the manifest's folder.
        sha256: SHA-256 of the file, 64 hexadecimal digits; empty where it is not known.
        tracker: Name of the system that made it.
        label: Its name in tables.
        sequence: Id of the sequence.
        provenance: Where the file comes from; the address by default.
        which: Whether its poses are the causal ones or those after the final optimisation.
        truth: The ground truth, an address or a path, where the sequence's images are not here.
        truth_sha256: SHA-256 of the ground truth's file, 64 hexadecimal digits.
    """

    model_config = ConfigDict(extra="forbid")

    file: str = Field(min_length=1)
    sha256: str = Field("", pattern="^([0-9a-f]{64})?$")
    tracker: str = Field(min_length=1)
    label: str = ""
    sequence: str = Field(min_length=1)
    provenance: str = ""
    which: TrajectoryKind = "final"
    truth: str = ""
    truth_sha256: str = Field("", pattern="^([0-9a-f]{64})?$")


class Manifest(Record):
    """A file that names trajectories of others; they are fetched, and checked against their checksums."""

    model_config = ConfigDict(extra="forbid")

    trajectory: list[StatedTrajectory]


def add(sources: Iterable[str | Path], bank: str | Path, *, protocol: str = "") -> Merged:
    """Add the runs of results folders and the trajectories of manifests to a bank; trials of studies are no results.

    Args:
        sources: Results folders, archives of such, and manifests (``.toml``).
        bank: The bank; it is made where there is none.
        protocol: Protocol under which its rows are compared; for a new bank the default one.

    Returns:
        What was added, what was there already, and what was left out, with reasons (see `merge`).

    Raises:
        RunError: A source holds no runs or is no manifest, or the bank has faults or another
            protocol.
        DynslamError: The bank cannot be written.
    """
    with ExitStack() as stack:
        stores = []
        left_out: list[Unreadable] = []
        for source in map(Path, sources):
            if source.suffix.lower() == ".toml":
                temporary = stack.enter_context(closing(TemporaryFolder()))
                store = RunStore(temporary.path)
                left_out += _import(source, store)
                stores.append(store)
            else:
                stores.append(open_store(source))
        merged = _merge(stores, bank, protocol)
    return Merged(merged.added, merged.stored, left_out + merged.left_out)


def read_manifest(path: Path) -> list[StatedTrajectory]:
    """The trajectories that a manifest names.

    Raises:
        RunError: It cannot be read, or is no manifest.
    """
    return validated(Manifest, read_toml(path, kind=RunError), str(path), RunError).trajectory


def _import(manifest: Path, store: RunStore) -> Iterator[Unreadable]:
    """Import what a manifest names; yields what cannot be, with reasons."""
    taken: dict[str, str] = {}
    with closing(TemporaryFolder()) as folder:
        for entry in read_manifest(manifest):
            try:
                # the files, checked, then the import
                file = _fetched(entry.file, entry.sha256, manifest.parent, folder.path)
                truth = None
                if entry.truth:
                    truth = _fetched(entry.truth, entry.truth_sha256, manifest.parent, folder.path)
                record = import_trajectory(
                    file,
                    entry.tracker,
                    entry.sequence,
                    results=store,
                    label=entry.label,
                    which=entry.which,
                    provenance=entry.provenance or entry.file,
                    truth=truth,
                )
                # a second table of the same id would replace the first one
                if record.run_id in taken:
                    same = f"the same trajectory of {entry.tracker} as {taken[record.run_id]}"
                    raise RunError(f"it has the id {record.run_id}, {same}")
                taken[record.run_id] = entry.file
            except InfrastructureError:
                raise
            except DynslamError as error:
                yield Unreadable(Path(entry.file), str(error))


def _fetched(place: str, sha256: str, base: Path, folder: Path) -> Path:
    """A file that a manifest names, checked.

    Args:
        place: Its address, or its path from the manifest's folder.
        sha256: Its checksum; empty where it is not known.
        base: The manifest's folder.
        folder: Where a downloaded file goes.

    Raises:
        DynslamError: It cannot be read or downloaded, or has another checksum.
    """
    # an address is downloaded, a path is read where it lies
    if _ADDRESS.fullmatch(place):
        target = folder / f"{digest(place)}.txt"
        download(place, target, sha256=sha256 or None)
        return target
    with translate_errors(RunError, f"cannot read {place}"):
        actual = file_sha256(base / place)
    if not actual.startswith(sha256):
        raise RunError(f"{place} has the checksum {actual}, expected {sha256}")
    return base / place


def verify(bank: str | Path) -> list[str]:
    """Every fault of a bank, one line each: files that are missing, changed or not listed, records that do not fit.

    Raises:
        RunError: There is no bank.
    """
    store = Bank(bank)
    # runs were being added: the list of checksums may lag behind
    if (store.root / UNFINISHED).exists():
        text = f"runs were being added when the process ended, or still are: {SUMS} may lack some of them"
        return [
            f"{text} (repeat the command, or add any other run)",
            *_faults(store, unfinished=True),
        ]
    if not (store.root / SUMS).is_file():
        raise RunError(
            f"{store.root} is no bank: it has no {SUMS}",
            "make one: dynslam-bench bank add RESULTS BANK",
        )
    return _faults(store)


def _faults(store: Bank, *, unfinished: bool = False) -> list[str]:
    """Every fault of a bank, one line each.

    Args:
        store: The bank.
        unfinished: Whether runs are still to be added to it: files may be without a checksum then.
    """
    sums = store.root / SUMS
    names = store.files()

    # files that are missing or changed, by their checksums
    faults: list[str] = []
    listed: set[str] = set()
    if sums.is_file() or not unfinished:
        faults += compare_sums(store.root, sums, RunError)
        listed = {line.rstrip("\n").partition("  ")[2] for line in read_lines(sums, kind=RunError)}

    # files that do not belong there
    links = [name for name in (*_CONTENT_FOLDERS, *names) if (store.root / name).is_symlink()]
    faults += [f"{name} is a link" for name in links]
    if unfinished:
        listed.update(names)
    faults += [f"{name} is not listed in {SUMS}" for name in names if name not in listed]

    # records that are damaged or do not fit
    faults += _doubled_rows(store)
    records, unreadable = store.all()
    faults += [f"{entry.path}: {entry.reason}" for entry in unreadable]
    for record in records:
        faults += [
            f"runs/{record.run_id}: {fault}" for fault in _faults_of_run(store, record, listed)
        ]
    return faults + _faults_of_marks(store)


def _doubled_rows(store: Bank) -> list[str]:
    """Rows that have the id of another one, a line each."""
    folders: dict[str, list[str]] = {}
    for file in sorted(store.runs.glob(f"*/{RUN_FILE}")):
        with suppress(DynslamError):  # damaged records are named elsewhere
            run_id = RunRecord.read(file).run_id
            folders.setdefault(run_id, []).append(f"runs/{file.parent.name}")
    return [
        f"{len(names)} rows have the id {run_id}: {', '.join(names)}"
        for run_id, names in folders.items()
        if len(names) > 1
    ]


def _faults_of_marks(store: Bank) -> list[str]:
    """Faults of a bank's description and marks, one line each."""
    try:
        description = read_description(store.root)
        digest_here = get_protocol(description.protocol).digest()
    except DynslamError as error:
        return [str(error)]
    faults = []
    if description.protocol_digest not in ("", digest_here):
        stated = description.protocol_digest
        faults.append(
            f"its protocol {description.protocol} has the digest {stated}, here {digest_here}"
        )
    marks, unreadable = read_marks(store.root)
    faults += [f"{entry.path}: {entry.reason}" for entry in unreadable]
    rows = set(store.ids())
    for mark in (mark for of_row in marks.values() for mark in of_row):
        if fault := mark.fault(description, rows):
            faults.append(f"{MARKS_FOLDER}/{mark.run_id}/{mark.by}.json: {fault}")
    return faults


def _faults_of_run(store: Bank, record: RunRecord, listed: Collection[str]) -> list[str]:
    """Faults of a run whose record can be read.

    Args:
        store: The bank.
        record: The run's.
        listed: Names of the files with checksums.
    """
    faults = []
    # the second is the id of older runs
    if record.run_id not in (run_id_of(record.identity), digest(record.identity, 16)):
        faults.append("its id is not that of what it says of itself")
    # what it says of itself must agree
    faults += [f"its {name} is not that of its identity" for name in _contradicted(record)]
    if f"sequences/{record.sequence.part}/{STAMPS}" not in listed:
        return [*faults, "the stamps of its sequence are missing"]
    try:
        store.check(record)
    except DynslamError as error:
        faults.append(str(error))
    return faults


def _contradicted(record: RunRecord) -> list[str]:
    """Fields of a record that are part of its identity, and differ from it."""
    stated = {
        "offset": record.offset,
        "stride": record.stride,
        "seed": record.seed,
        "device": record.device,
        "threads": record.threads,
        "realtime": record.realtime,
        "tracker": record.tracker.id,
        "tracker_version": record.tracker.version,
        "drop_share": record.drop_share,
        "sequence": _without_length(record.sequence.id),
        "content": record.sequence.content,
        "degrade": record.degrade,
    }
    return [name for name, value in stated.items() if record.identity.get(name, value) != value]


def _without_length(sequence: str) -> str:
    """The id that an identity has: of a rendered sequence without its length, whose frames stand beside it."""
    if not sequence.startswith("synthetic/"):
        return sequence
    try:
        return parse_synthetic_id(sequence).whole
    except DynslamError:  # of a family that this release does not have
        return sequence


def pull(source: str, bank: str | Path) -> Merged:
    """Add the runs of another bank.

    Args:
        source: A folder, a git repository, or the address of an archive (``.zip``, ``.tgz``,
            ``.tar``).
        bank: The bank that gets them.

    Raises:
        RunError: One of the two has faults, or the source is no bank.
        DynslamError: It cannot be fetched, or the bank not be written.
    """
    with ExitStack() as stack:
        # a folder as it is, an archive downloaded, a repository cloned
        store = RunStore(source)
        if _ARCHIVE.fullmatch(source):
            temporary = stack.enter_context(closing(TemporaryFolder()))
            archive = temporary.path / Path(source.partition("?")[0]).name
            download(source, archive)
            store = open_store(archive)
        elif _is_repository(source):
            store = RunStore(stack.enter_context(_cloned(source)))
        # messages name the folder, or the end of an address
        store.source = Path(source) if Path(source).exists() else Path(Path(source).name)
        if not (store.root / SUMS).is_file():
            raise RunError(f"{source} is no bank: it has no {SUMS}")
        check_sound(store.root)
        return _merge([store], bank)


def push(bank: str | Path, target: str) -> Merged:
    """Add the runs of a bank to another one.

    Args:
        bank: The bank.
        target: A folder, or a git repository, which gets a commit.

    Raises:
        RunError: One of the two has faults, or git refuses, e.g. since another push came first.
        DynslamError: The target cannot be written.
    """
    check_sound(bank)
    if not _is_repository(target):
        return _merge([RunStore(bank)], target)
    with _cloned(target) as clone:
        # a repository that holds something else is no bank
        others = [
            path.name
            for path in clone.iterdir()
            if not path.name.startswith((".", "README", "LICENSE"))
        ]
        if others and SUMS not in others:
            raise RunError(
                f"{target} is no bank: it has no {SUMS}, and holds {others[0]}",
                "push to an empty repository",
            )
        # add to the clone, then commit and push it
        merged = _merge([RunStore(bank)], clone)
        _commit(clone, f"Add runs: {len(merged.added)}" if merged.added else "Add marks")
    return merged


def _commit(clone: Path, message: str) -> None:
    """Commit what is new in a clone of a bank, if anything, and push it.

    Raises:
        RunError: git refuses.
    """
    parts = (SUMS, DESCRIPTION_FILE, *_CONTENT_FOLDERS)
    present = [name for name in parts if (clone / name).exists()]
    _git(clone, "add", "--force", "--", *present)
    if not _git(clone, "diff", "--cached", "--name-only"):
        return
    _git(clone, "commit", "--quiet", "--message", message)
    _git(clone, "push", "--quiet", "origin", "HEAD")


def add_mark(bank: str | Path, mark: Mark) -> None:
    """Add a mark to a bank, in place of an earlier one by the same name.

    Raises:
        RunError: The bank has faults, or the mark does not fit it.
        InfrastructureError: It cannot be written.
    """
    with _changing(bank) as store:
        if fault := mark.fault(read_description(store.root), store.ids()):
            raise RunError(f"no mark: {fault}")
        write_atomic(mark_file(store.root, mark.run_id, mark.by), mark.to_json())


def _merge(sources: Sequence[RunStore], bank: str | Path, protocol: str = "") -> Merged:
    """Merge stores into a bank: the runs, the marks, and the bank's description.

    Args:
        sources: Results folders and banks.
        bank: The bank.
        protocol: Its protocol; empty for that of a source that is a bank, or the default one.
    """
    with _changing(bank) as store:
        description = _joined_description(sources, store, protocol)
        # rendering may fail: before anything is added
        probes = _probes_of(sources, description)
        merged = merge(sources, store, trials=False)
        for source in sources:
            merged.left_out.extend(_copy_marks(source, store))
        whole = description.model_copy(update={"probes": probes})
        write_atomic(store.root / DESCRIPTION_FILE, whole.to_json())
    return merged


def _joined_description(sources: Sequence[RunStore], store: Bank, protocol: str) -> BankDescription:
    """The description of a bank after those of the sources that are banks.

    Raises:
        RunError: They do not fit each other, or the bank has another protocol.
    """
    described = [source for source in sources if (source.root / DESCRIPTION_FILE).is_file()]
    is_new = not store.ids() and not (store.root / DESCRIPTION_FILE).is_file()
    if not is_new:
        joined = read_description(store.root)
    elif protocol or not described:
        joined = new_description(protocol or DEFAULT_PROTOCOL)
    else:
        joined = read_description(described[0].root)
    if protocol and joined.protocol != protocol:
        raise RunError(
            f"{store.root} is a bank under {joined.protocol}, not {protocol}",
            "name another bank, or leave --protocol out",
        )
    for source in described:
        other = read_description(source.root)
        if difference := joined.difference(other):
            raise RunError(f"{source.source} and {store.root} do not fit: {difference}")
        joined = joined.model_copy(update={"probes": other.probes | joined.probes})
    return joined


def _probes_of(sources: Sequence[RunStore], description: BankDescription) -> dict[str, str]:
    """The digests of a bank's rendered families; those that results folders bring are rendered here."""
    probes = dict(description.probes)
    for source in sources:
        if (source.root / SUMS).is_file():  # a bank has its own
            continue
        for record in source.all()[0]:
            if record.kind != "run" or not record.sequence.id.startswith("synthetic/"):
                continue
            probe = probe_id(parse_synthetic_id(record.sequence.id).name)
            if probe not in probes:
                from dynslam_bench.sequences.synthetic.digests import probe_digest

                probes[probe] = probe_digest(probe)
    return probes


def _copy_marks(source: RunStore, store: Bank) -> Iterator[Unreadable]:
    """Copy the marks of rows that a bank has, the newer of two by one name; yields those that do not fit."""
    marks, unreadable = read_marks(source.root)
    yield from unreadable
    here, _ = read_marks(store.root)
    description = read_description(source.root)
    rows = set(store.ids())
    for run_id, of_row in marks.items():
        made_before = {mark.by: mark.made for mark in here.get(run_id, ())}
        for mark in of_row:
            if fault := mark.fault(description, rows):
                yield Unreadable(mark_file(source.root, run_id, mark.by), fault)
            elif mark.made > made_before.get(mark.by, ""):
                write_atomic(mark_file(store.root, run_id, mark.by), mark.to_json())


@contextmanager
def _changing(bank: str | Path) -> Iterator[Bank]:
    """A bank without faults while it is changed, by one process at a time; its checksums are right afterwards.

    It goes on where a process was killed that did the same.
    """
    store = Bank(bank)
    unfinished = store.root / UNFINISHED
    with translate_errors(InfrastructureError, f"cannot write {store.root}", "name another folder"):
        store.root.mkdir(parents=True, exist_ok=True)
    # one process at a time; the bank must be sound before
    with exclusive_lock(store.root / ".merging"):
        if unfinished.exists():
            _refuse(store.root, _faults(store, unfinished=True))
        elif (store.root / SUMS).exists() or store.files():
            check_sound(store.root)
        # a mark that stands until the checksums are right again
        write_atomic(unfinished, "")
        try:
            yield store
        finally:  # what was copied before a fault is whole
            _write_sums(store)
            with translate_errors(
                InfrastructureError, f"cannot remove {unfinished}", "repeat the command"
            ):
                unfinished.unlink(missing_ok=True)


def _write_sums(store: Bank) -> None:
    """Write the checksums of all files.

    Raises:
        InfrastructureError: A file cannot be read, or the list not be written.
    """
    lines = []
    for name in store.files():
        with translate_errors(
            InfrastructureError, f"cannot read {store.root / name}", "repeat the command"
        ):
            lines.append(f"{file_sha256(store.root / name)}  {name}\n")
    write_atomic(store.root / SUMS, "".join(lines))


def check_sound(bank: str | Path) -> None:
    """Refuse a bank that has faults.

    Raises:
        RunError: It has some, or is no bank.
    """
    _refuse(bank, verify(bank))


def _refuse(bank: str | Path, faults: Sequence[str]) -> None:
    """Raise the first of the faults of a bank, if there are any."""
    if faults:
        raise RunError(
            f"{bank} has faults, of {len(faults)} the first: {faults[0]}", "bank verify lists all"
        )


def _is_repository(place: str) -> bool:
    """Whether a place is a git repository that has to be cloned: an address, or a bare one."""
    return _ADDRESS.fullmatch(place) is not None or (
        Path(place, "HEAD").is_file() and Path(place, "objects").is_dir()
    )


@contextmanager
def _cloned(repository: str) -> Iterator[Path]:
    """A clone of a git repository, in a temporary folder that is removed afterwards.

    Raises:
        RunError: git is not installed, or refuses.
    """
    with closing(TemporaryFolder()) as folder:
        origin = repository if _ADDRESS.fullmatch(repository) else str(Path(repository).absolute())
        name = re.sub(r"[^\w.-]", "-", Path(origin).resolve().name) or "bank"
        # messages name the repository, not the temporary folder
        clone = hide_folder_in_messages(folder.path) / name
        # checksums are of the bytes: git is not to change ends of lines
        options = ("--quiet", "--config", "core.autocrlf=false")
        _git(folder.path, "clone", *options, "--", origin, str(clone))
        yield clone


def _git(folder: Path, verb: str, *words: str) -> str:
    """Run git in a folder; returns what it writes.

    Raises:
        RunError: It is not installed, or refuses.
    """
    with translate_errors(RunError, "cannot start git", "install it"):
        done = subprocess.run(
            ["git", verb, *words],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
            stdin=subprocess.DEVNULL,
        )
    if done.returncode:
        raise RunError(
            f"git {verb} ended with exit code {done.returncode}: {' '.join(done.stderr.split())[-400:]}"
        )
    return done.stdout
