"""The run store: one folder a run, which appears whole or not at all; how it is written, read and scored."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import warnings
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core import (
    DynslamError,
    EvaluationError,
    InfrastructureError,
    RunError,
    TemporaryFolder,
    did_you_mean,
    file_sha256,
    read_lines,
    replace_folder,
    sweep_temporary,
    temporary_folder,
    translate_errors,
    try_lock,
    write_atomic,
)
from dynslam_bench.core.errors import hide_folder_in_messages
from dynslam_bench.core.module_graph import PACKAGE, PLUMBING, module_graph
from dynslam_bench.core.plugins import ISOLATED_VARIABLE, has_imported_plugins
from dynslam_bench.core.reads import remembered
from dynslam_bench.evaluation import Evaluation, Protocol, evaluate, get_protocol, hints
from dynslam_bench.evaluation.uncertainty import truth_noise
from dynslam_bench.geometry import Trajectory, read_tum
from dynslam_bench.geometry.motion_covariances import (
    MotionCovariances,
    read_motion_covariances,
)
from dynslam_bench.runs.index import RunIndex
from dynslam_bench.runs.layout import (
    COVARIANCES,
    FINAL,
    ONLINE,
    REMOVED_HINT,
    RUN_FILE,
    STAMPS,
    TRUTH,
    TrajectoryKind,
    Unreadable,
    check_plain,
    checked_id,
    file_stamp,
    have_equal_files,
    is_id,
    read_errors,
)
from dynslam_bench.runs.record import MetricRecord, RunRecord, run_id_of
from dynslam_bench.runs.rows import runs_frame
from dynslam_bench.runs.sequence_parts import SequenceParts

if TYPE_CHECKING:
    import pandas as pd

LOGGER = logging.getLogger(__name__)
DEFAULT_PROTOCOL = "tum-rgbd/v1"


def _sha256_of(path: str) -> str:
    """SHA-256 of a file; see `file_sha256`."""
    return file_sha256(Path(path))


class RunStore:
    """Runs and the sequences' ground truth below one folder.

    ``runs/<run_id>/`` holds ``run.json``, ``trajectory_online.txt``, ``trajectory_final.txt``,
    ``frames.csv``, ``keyframes.csv``, ``map.ply`` and ``log.txt``; ``sequences/<part>/`` stamps and
    ground truth, so that a run can be scored again without its data; ``index.sqlite`` metrics and
    rows of tables, which are computed from these; ``latest`` links the newest run.

    Args:
        root: The folder; it is made when something is written.

    Attributes:
        root: The folder, absolute.
        source: What messages call it: the folder, or the archive that it was unpacked from.
        runs: Folder of the runs.
        sequences: Stamps and ground truth of the parts of sequences.
        index: What was computed from the runs.
    """

    def __init__(self, root: str | Path = "results") -> None:
        self.root = Path(root).expanduser().absolute()
        self.source = self.root
        self.runs = self.root / "runs"
        self.sequences = SequenceParts(self.root)
        self.index = RunIndex(self.root)

    def folder(self, run_id: str) -> Path:
        """Folder of one run, whether it exists or not.

        Raises:
            RunError: It is no run's id, which is 20 hexadecimal digits (16 of older runs): anything
                else could lead out of the store.
        """
        return self.runs / checked_id(run_id, "a run's id")

    def shown_folder(self, run_id: str) -> Path:
        """Folder of one run as messages name it: below the archive that the store was unpacked from."""
        return self.source / "runs" / run_id

    # -- writing -----------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Make sure that runs can be stored, and remove what killed processes left behind.

        Raises:
            DynslamError: The folder cannot be written.
        """
        with temporary_folder(self.runs / "probe"):  # fails where nothing can be written
            pass
        for pattern in (".*", "runs/.*", "sequences/*/.*", "studies/*/**/.*"):
            sweep_temporary(self.root, pattern)
        for claim in self.runs.glob(".*.claim"):
            with try_lock(claim):  # if no process holds it, it is removed
                pass
        self._unlink_dangling_latest()

    def work_folder(self, run_id: str) -> AbstractContextManager[Path]:
        """A hidden folder to make a run in; it vanishes unless `publish` moved it into place.

        Raises:
            DynslamError: The store cannot be written.
        """
        return temporary_folder(self.folder(run_id))

    def claim(self, run_id: str) -> AbstractContextManager[bool]:
        """Make a run alone while the block lasts; it is given False where another process or thread is making it.

        Raises:
            DynslamError: The store cannot be written.
        """
        return try_lock(self.runs / f".{run_id}.claim")

    def publish(self, work: Path, record: RunRecord) -> RunRecord:
        """Write the record, ``run.json``, into its work folder, rename that to the run's; replaces a run of the id.

        Returns:
            The record as it is stored, with a note if the earlier run gave another result.

        Raises:
            InfrastructureError: It cannot be written; then nothing has changed.
        """
        record = self._with_free_id(record)
        record = self._with_note_on_difference(record, work)
        target = self.folder(record.run_id)
        with translate_errors(
            InfrastructureError, f"cannot write {target}", "check the free space"
        ):
            files = record.files or self._checksums(record.sequence.part, work)
            record = record.model_copy(update={"files": files})
            (work / RUN_FILE).write_text(record.to_json(), encoding="utf-8")
            replace_folder(work, target)
        self.link_latest(record.run_id)
        return record

    def link_latest(self, run_id: str) -> None:
        """Let ``latest`` lead to a run."""
        link = self.root / "latest"
        # a file system may have no links
        with contextlib.suppress(OSError), temporary_folder(link) as folder:
            fresh = folder / link.name
            fresh.symlink_to(self.folder(run_id).relative_to(self.root))
            fresh.replace(link)

    def _with_free_id(self, record: RunRecord) -> RunRecord:
        """The record, with another id where a run of another identity has that one: such a run is not overwritten."""
        earlier = self.get(record.run_id)
        while earlier is not None and earlier.identity != record.identity:
            identity = record.identity | {"id_taken_by": earlier.run_id}
            record = record.model_copy(update={"identity": identity, "run_id": run_id_of(identity)})
            earlier = self.get(record.run_id)
        return record

    def _checksums(self, part: str, run: Path) -> dict[str, str]:
        """SHA-256 of the files that a run's values are computed from, by the file's name; missing files are left out.

        Args:
            part: The run's part of a sequence.
            run: Folder of the run.

        Raises:
            RunError: One cannot be read.
        """
        sequence = self.sequences.folder(part)
        checksums = {}
        for folder, names in ((run, (ONLINE, FINAL, COVARIANCES)), (sequence, (TRUTH, STAMPS))):
            for name in names:
                path = f"{folder}/{name}"
                if not os.path.isfile(path):  # noqa: PTH113 - of thousands of runs, as `file_stamp`
                    continue
                with read_errors(path):
                    # many runs share the files of a sequence: each is read once a process
                    checksums[name] = remembered("sha256", path, partial(_sha256_of, path))
        return checksums

    def changed(self, record: RunRecord) -> str:
        """The first file that is not the one with which a run was stored, and what happened to it; empty for none."""
        present = self._checksums(record.sequence.part, self.folder(record.run_id))
        for name, checksum in record.files.items():
            if present.get(name) != checksum:
                happened = "was changed" if name in present else "is missing"
                return f"{name} {happened} since run {record.run_id} was stored (run it again, or copy the file again)"
        return ""

    def _with_note_on_difference(self, record: RunRecord, work: Path) -> RunRecord:
        """The record, with a note where an earlier run of its id, which should be equal, gave another trajectory."""
        earlier = self.get(record.run_id)
        if earlier is None or earlier.status != "ok" or record.status != "ok":
            return record
        if record.realtime or not record.tracker.deterministic:
            return record
        if have_equal_files(work, self.folder(record.run_id), ONLINE):
            return record
        note = (
            f"an earlier run with this id, started {earlier.started}, gave another trajectory, although tracker "
            f"'{record.tracker.id}' is declared deterministic"
        )
        LOGGER.warning("run %s: %s", record.run_id, note)
        return record.model_copy(update={"notes": [*record.notes, note]})

    def copy_from(self, other: RunStore, record: RunRecord) -> RunRecord:
        """Copy a run of another store, with its part of a sequence; replaces an earlier run of the id.

        Raises:
            InfrastructureError: It cannot be written.
            RunError: It was removed or changed while it was copied.
        """
        self.copy_stamps_and_truth(other, record)
        with self.work_folder(record.run_id) as work:
            with self.copying(other, record):
                shutil.copytree(other.folder(record.run_id), work, dirs_exist_ok=True)
            self.check_copy(work, record)
            return self.publish(work, record)

    @contextlib.contextmanager
    def copying(self, other: RunStore, record: RunRecord) -> Iterator[None]:
        """Turn what fails while a run of another store is copied into an error that says whose fault it is.

        Raises:
            RunError: The run was removed meanwhile.
            InfrastructureError: It cannot be written here.
        """
        target = self.folder(record.run_id)
        try:
            with translate_errors(
                InfrastructureError, f"cannot write {target}", "check the free space"
            ):
                yield
        except InfrastructureError as error:
            if (other.folder(record.run_id) / RUN_FILE).is_file():
                raise
            raise RunError(
                f"{other.shown_folder(record.run_id)} was removed while it was copied"
            ) from error

    def check_copy(self, work: Path, record: RunRecord) -> None:
        """Check that a copied run has the trajectories that it was stored with.

        Raises:
            RunError: One is missing or another one.
        """
        copied = self._checksums(record.sequence.part, work)
        for name in (ONLINE, FINAL, COVARIANCES):
            if copied.get(name) != record.files.get(name, copied.get(name)):
                raise RunError(
                    f"{name} of run {record.run_id} was removed or changed while it was copied"
                )

    def copy_stamps_and_truth(self, other: RunStore, record: RunRecord) -> None:
        """Copy the ground truth and then the stamps of a run's part of a sequence, if its stamps are not here.

        Raises:
            InfrastructureError: They cannot be written.
            RunError: They cannot be read.
        """
        self.sequences.copy_from(other.sequences, record.sequence.part)

    def add_sequence(
        self, part: str, timestamps_ns: NDArray[np.int64], ground_truth: Trajectory | None
    ) -> None:
        """Keep the stamps of a sequence's frames, in nanoseconds, and its ground truth, in place of other ones."""
        self.sequences.add(part, timestamps_ns, ground_truth)

    def rewrite(self, record: RunRecord, **changes: Any) -> RunRecord:
        """Change fields of a stored run that are no part of its outcome: its label in tables, the study that made it.

        Raises:
            DynslamError: It cannot be written.
        """
        changed = (self.get(record.run_id) or record).model_copy(update=changes)
        write_atomic(self.folder(record.run_id) / RUN_FILE, changed.to_json())
        return changed

    def remove(self, run_id: str) -> None:
        """Delete a run; its values in the index hold no more.

        Raises:
            RunError: There is no such run, or it cannot be deleted.
        """
        run_id = self.find(run_id)
        with (
            translate_errors(RunError, f"cannot remove run {run_id}"),
            self.work_folder(run_id) as removed,
        ):
            self.folder(run_id).rename(removed / run_id)
        self._unlink_dangling_latest()

    def _unlink_dangling_latest(self) -> None:
        """Remove ``latest`` where its run is gone."""
        latest = self.root / "latest"
        if latest.is_symlink() and not latest.exists():
            latest.unlink(missing_ok=True)

    # -- reading -----------------------------------------------------------------------------------

    def ids(self) -> list[str]:
        """Ids of all stored runs, sorted."""
        try:
            with os.scandir(self.runs) as entries:
                return sorted(
                    entry.name for entry in entries if is_id(entry.name) and entry.is_dir()
                )
        except (FileNotFoundError, NotADirectoryError):
            return []

    def read(self, run_id: str) -> RunRecord:
        """The record of a run by its id, the id's first digits, or ``latest``.

        Raises:
            RunError: There is no such run.
            DynslamError: Its record is damaged.
        """
        return self.read_whole(self.find(run_id))

    def get(self, run_id: str) -> RunRecord | None:
        """The record of a run by its full id, None if it is not stored or damaged."""
        checked_id(run_id, "a run's id")
        with contextlib.suppress(DynslamError):
            return self.read_whole(run_id)
        return None

    def read_whole(self, run_id: str) -> RunRecord:
        """The record of a run by its full id.

        Raises:
            DynslamError: It is missing or damaged, names itself otherwise, or its folder holds more
                than plain files.
        """
        folder = self.folder(run_id)
        path = folder / RUN_FILE
        check_plain(folder, self.root)
        try:
            record = RunRecord.read(path)
        except DynslamError as error:
            if folder.is_dir():
                raise
            raise RunError(f"run {run_id} is not in {self.source}", REMOVED_HINT) from error
        if record.run_id != run_id:
            raise RunError(
                f"{path} names itself {record.run_id}, not as its folder",
                "it was copied or made by hand",
            )
        return record

    def read_with_state(self, run_id: str) -> tuple[RunRecord, str]:
        """The record of a run by its full id, and its state for values that are computed from it, see `RunIndex`."""
        stamp = file_stamp(self.folder(run_id) / RUN_FILE)
        record = self.read_whole(run_id)
        return record, self.index.state(run_id, record.sequence.part, stamp)

    def all(self) -> tuple[Records, list[Unreadable]]:
        """All runs from the oldest to the newest, and the folders that hold no valid record, with reasons."""
        started = []
        unreadable = []
        for run_id in self.ids():
            try:
                started.append((self.read_whole(run_id).started, run_id))
            except DynslamError as error:
                unreadable.append(Unreadable(self.shown_folder(run_id), str(error)))
        return Records(self, [run_id for _, run_id in sorted(started)]), unreadable

    def find(self, prefix: str) -> str:
        """The full id of a run from its first digits, or of ``latest``.

        Raises:
            RunError: No run, or more than one, begins so.
        """
        if prefix == "latest" and (self.root / "latest").exists():
            return (self.root / "latest").resolve().name
        run_ids = self.ids()
        matching = [run_id for run_id in run_ids if run_id.startswith(prefix)] if prefix else []
        if len(matching) == 1:
            return matching[0]
        if matching:
            raise RunError(f"{len(matching)} runs begin with '{prefix}'", ", ".join(matching[:5]))
        hint = did_you_mean(prefix, run_ids) or f"there are no runs in {self.source}"
        raise RunError(f"there is no run '{prefix}'", hint)

    def trajectory(self, run_id: str, which: str = "online") -> Trajectory | None:
        """The ``online`` or ``final`` trajectory of a run; None if there is none or no frame was tracked."""
        path = self.folder(run_id) / f"trajectory_{which}.txt"
        if not path.is_file():
            return None
        lines = read_lines(path, kind=RunError)
        has_pose = any(line.strip() and line[0] != "#" for line in lines)
        return read_tum(path) if has_pose else None

    def ground_truth(self, part: str, *, repeats: bool = False) -> Trajectory | None:
        """The ground truth of a sequence's part, with `repeats` all poses of a repeated stamp; None if it has none."""
        return self.sequences.ground_truth(part, repeats=repeats)

    def timestamps(self, part: str) -> NDArray[np.float64]:
        """Stamps in seconds of all input frames of a sequence's part.

        Raises:
            RunError: They are not stored, or damaged.
        """
        return self.sequences.timestamps(part)

    def check(self, record: RunRecord) -> None:
        """Read the trajectories of a run, and the stamps and the ground truth of its part of a sequence.

        Raises:
            DynslamError: One is damaged or was changed, or the stamps are missing.
        """
        self.timestamps(record.sequence.part)
        self.ground_truth(record.sequence.part)
        self.trajectory(record.run_id, "online")
        self.trajectory(record.run_id, "final")
        if fault := self.changed(record):
            raise RunError(fault)

    # -- scores ------------------------------------------------------------------------------------

    def metrics(self, record: RunRecord, protocol: Protocol) -> MetricRecord | None:
        """A run's stored metrics under a protocol; None if it was not scored under it, or they are out of date.

        Metrics hold for one version of the evaluation code and one state of the trajectories and
        the ground truth.
        """
        text = self.index.get(metrics_name(protocol), evaluation_code(), record.run_id)
        if text is None:
            return None
        try:
            metrics = MetricRecord.parse(text, f"metrics of run {record.run_id}")
        except DynslamError:  # damaged: the run is scored again
            return None
        is_of_run = metrics.run_id == record.run_id
        return metrics if is_of_run and metrics.protocol_digest == protocol.digest() else None

    def add_metrics(self, record: RunRecord, metrics: MetricRecord, state: str = "") -> None:
        """Keep a run's metrics under a protocol.

        Args:
            record: The run.
            metrics: The metrics.
            state: State of the run's files when they were computed, see `RunIndex.state`; empty for
                the present one.
        """
        state = state or self.index.state(record.run_id, record.sequence.part)
        entry = (record.run_id, state, metrics.to_line())
        self.index.write(f"metrics {metrics.protocol_digest}", metrics.code, [entry])

    def score(
        self, record: RunRecord, protocol: Protocol | str = DEFAULT_PROTOCOL, *, again: bool = False
    ) -> MetricRecord:
        """The metrics of a stored run under a protocol, from its stored trajectories and ground truth.

        Args:
            record: The run.
            protocol: A protocol or its id.
            again: Compute them even if they are stored.

        Returns:
            The metrics; evaluations that are not possible are None, with the reason.
        """
        protocol = get_protocol(protocol)
        stored = None if again else self.metrics(record, protocol)
        if stored is not None:
            return stored
        if has_imported_plugins() and not os.environ.get(ISOLATED_VARIABLE):
            from dynslam_bench.runs.scoring import score_apart

            return score_apart(self, record.run_id, protocol, again=again)
        state = self.index.state(record.run_id, record.sequence.part)  # before the files are read
        metrics = self._evaluate(record, protocol)
        self.add_metrics(record, metrics, state)
        return metrics

    def _evaluate(self, record: RunRecord, protocol: Protocol) -> MetricRecord:
        """Evaluate both trajectories of a run, and say why one cannot be evaluated."""
        evaluations: dict[TrajectoryKind, Evaluation | None] = {"online": None, "final": None}
        reasons: dict[str, str] = {}
        hint_lines: list[str] = []
        for which in evaluations:
            try:
                trajectory, truth, stamps = self._inputs(record, protocol, which)
                evaluations[which] = evaluate(
                    trajectory,
                    truth,
                    protocol,
                    input_timestamps=stamps,
                    motion_covariances=self._covariances(record, which),
                    truth_noise=truth_noise(record.sequence.id),
                )
            except DynslamError as error:
                reasons[which] = str(error)
                continue
            # the hints are on the trajectory that the protocol asks for, else on the other one
            if which == protocol.trajectory or not evaluations[protocol.trajectory]:
                hint_lines = [str(hint) for hint in hints(trajectory, truth, protocol)]
        return MetricRecord(
            run_id=record.run_id,
            protocol_id=protocol.id,
            protocol_digest=protocol.digest(),
            code=evaluation_code(),
            trajectory=self._scored_trajectory(record, protocol),
            **evaluations,
            reasons=reasons,
            hints=hint_lines,
        )

    def _covariances(self, record: RunRecord, which: TrajectoryKind) -> MotionCovariances | None:
        """The covariances that a tracker gave with its online poses; None where it gave none.

        Raises:
            DynslamError: Their file is damaged.
        """
        path = self.folder(record.run_id) / COVARIANCES
        if which != "online" or not path.is_file():
            return None
        return read_motion_covariances(path)

    def _scored_trajectory(self, record: RunRecord, protocol: Protocol) -> TrajectoryKind:
        """The trajectory that the protocol asks for, or the only one that a run has."""
        if record.kind == "imported":
            return "online" if (self.folder(record.run_id) / ONLINE).is_file() else "final"
        return protocol.trajectory if record.tracker.online else "final"

    def _inputs(
        self, record: RunRecord, protocol: Protocol, which: TrajectoryKind
    ) -> tuple[Trajectory, Trajectory, NDArray[np.float64] | None]:
        """Inputs of the evaluation of one of a run's trajectories.

        Returns:
            The trajectory, the ground truth, and the stamps of all input frames in seconds; None in
            place of the stamps where the poses carry others.

        Raises:
            DynslamError: One is missing, damaged or was changed, or the protocol does not fit the
                sequence or the tracker.
        """
        protocol.check_sequence(record.sequence.id)
        protocol.check_scale(record.tracker.id, record.tracker.sensors)
        part = record.sequence.part
        check_plain(self.sequences.folder(part), self.root)
        if fault := self.changed(record):
            raise RunError(fault)
        truth = self.ground_truth(part, repeats=not protocol.one_to_one)
        if truth is None:
            raise EvaluationError(f"sequence '{record.sequence.id}' has no ground truth")
        trajectory = self.trajectory(record.run_id, which)
        if trajectory is None:
            raise EvaluationError("there is no such trajectory, or it holds no tracked frame")
        stamps = self.timestamps(part) if record.stamps_match else None
        return trajectory, truth, stamps

    def frame(
        self, protocol: Protocol | str = DEFAULT_PROTOCOL, *, trials: bool = False
    ) -> pd.DataFrame:
        """All runs, scored under one protocol, as a pandas frame: one row a run, from the oldest to the newest.

        Args:
            protocol: How to evaluate; SLAM is never run again for it.
            trials: Whether the trials of studies are listed, too: their settings are candidates, no
                results.

        Returns:
            The columns that `runs_frame` describes.
        """
        records, unreadable = self.all()
        reasons = [f"{entry.path}: {entry.reason}" for entry in unreadable]

        def scored() -> Iterator[tuple[RunRecord, MetricRecord | None]]:
            """Each readable run with its metrics; those that cannot be read give a reason."""
            for run_id in records.run_ids:
                try:
                    record = self.read_whole(run_id)
                    if record.trial_of and not trials:
                        continue
                    is_scored = record.status != "stopped"
                    yield record, self.score(record, protocol) if is_scored else None
                except DynslamError as error:
                    reasons.append(f"{self.shown_folder(run_id)}: {error}")

        frame = runs_frame(scored())
        warn_of_unreadable(reasons)
        return frame


def warn_of_unreadable(reasons: Sequence[str]) -> None:
    """Warn of runs that a table leaves out."""
    if reasons:
        warnings.warn(
            f"{len(reasons)} runs cannot be read and are left out, the first: {reasons[0]}",
            RuntimeWarning,
            stacklevel=3,
        )


@dataclass(frozen=True, eq=False)
class Records(Sequence[RunRecord]):
    """The records of many runs; each is read from the store when it is asked for.

    Attributes:
        store: The store.
        run_ids: The runs.
        not_stored: The records of those that are not in the store.
    """

    store: RunStore
    run_ids: list[str]
    not_stored: Mapping[str, RunRecord] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.run_ids)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[at] for at in range(len(self))[index]]
        run_id = self.run_ids[index]
        return self.not_stored.get(run_id) or self.store.read_whole(run_id)


def open_store(results: str | Path) -> RunStore:
    """The store of a results folder that exists, or of an archive of one (``.tar``, ``.tgz``, ``.zip``).

    An archive is unpacked into a temporary folder, which is removed with the store.

    Raises:
        RunError: There are no runs in it.
        SequenceError: The archive is damaged, or holds links or names that lead out of it.
        InfrastructureError: It cannot be unpacked here.
    """
    store = RunStore(results)
    if store.root.is_file():
        store = _unpacked(store.root, results)
    if not store.runs.is_dir():
        raise RunError(f"there are no runs in {results}", "name a folder that holds runs")
    return store


def _unpacked(archive: Path, results: str | Path) -> RunStore:
    """The store that an archive holds, in a temporary folder that is removed with it.

    Args:
        archive: The archive.
        results: Its path as messages name it.
    """
    from dynslam_bench.sequences.fetch import extract  # loads what fetches sequences

    with translate_errors(InfrastructureError, f"cannot unpack {results}", "check the free space"):
        temporary = TemporaryFolder()
        unpacked = hide_folder_in_messages(temporary.path) / archive.name
        unpacked.mkdir()
        extract(archive, unpacked)

    # the results folder lies anywhere in the archive; deeper ones are, e.g., a study's own runs
    roots = [path.parent for path in unpacked.rglob("runs") if path.is_dir()]
    depth = min((len(root.parts) for root in roots), default=0)
    roots = [root for root in roots if len(root.parts) == depth]
    if len(roots) > 1:
        raise RunError(
            f"{results} holds {len(roots)} results folders",
            "pack each into an archive of its own",
        )
    store = RunStore(roots[0] if roots else unpacked)
    store.source = archive
    weakref.finalize(store, temporary.close)
    return store


def evaluation_code() -> str:
    """Digest of the code that metrics are computed by."""
    parts = [f"{PACKAGE}.evaluation.evaluate", f"{PACKAGE}.evaluation.hints"]
    return module_graph().digest(parts, PLUMBING)[:12]


def metrics_name(protocol: Protocol) -> str:
    """The name of the metrics under a protocol in the index."""
    return f"metrics {protocol.digest()}"


def score(
    store: RunStore,
    record: RunRecord,
    protocol: Protocol | str = DEFAULT_PROTOCOL,
    *,
    again: bool = False,
) -> MetricRecord:
    """The metrics of a stored run under a protocol, see `RunStore.score`."""
    return store.score(record, protocol, again=again)


@dataclass(frozen=True)
class Merged:
    """Runs that `copying.merge` copied, that were stored already, and that it left out.

    Attributes:
        added: Ids of the runs that were copied.
        stored: Ids of the runs that the store had already, with the same result.
        left_out: Folders of the runs that were not copied, with reasons.
    """

    added: list[str]
    stored: list[str]
    left_out: list[Unreadable]
