"""Making one run: in a child process, stored whatever becomes of it."""

import contextlib
import shutil
import time
from collections.abc import Callable
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any

from dynslam_bench.contracts import exact_stamps, timestamps_ns
from dynslam_bench.core import InfrastructureError, RunError, translate_errors
from dynslam_bench.core.plugins import ENVIRONMENT_VARIABLE
from dynslam_bench.core.reads import Reads
from dynslam_bench.evaluation import Protocol, get_protocol
from dynslam_bench.runs.frames import FRAMES_FILE, FrameLog
from dynslam_bench.runs.identity import ResolvedRun, check_unchanged, resolve
from dynslam_bench.runs.make_record import make_record
from dynslam_bench.runs.own_code import plugins_of_run
from dynslam_bench.runs.process.fork_server import Child, ForkServer
from dynslam_bench.runs.process.jobs import LOG_FILE, READS_FILE, make_job
from dynslam_bench.runs.process.supervisor import (
    LONGEST_LOG,
    LONGEST_YET,
    ProcessEnd,
    ServerDiedError,
    bound_log,
    supervise,
)
from dynslam_bench.runs.record import RunRecord
from dynslam_bench.runs.spec import RunSpec
from dynslam_bench.runs.store import DEFAULT_PROTOCOL, RunStore

CHILD_ENTRY_POINT = "dynslam_bench.runs.loop:run_loop"
"""The function of the child process; `process.child` imports and calls it."""
PROGRESS_EVERY = 50
"""Frames between two reports of partial metrics."""
OnProgress = Callable[[str, dict[str, Any]], bool]
"""Called as ``on_progress(run_id, partial)`` every `PROGRESS_EVERY` frames; returning False stops the run.

`partial` holds ``frames_done``, ``frames``, ``metrics`` (of the frames so far under the protocol),
``frame_time_s`` and ``pose_error_trans_m``.
"""


def run_one(
    run: RunSpec | ResolvedRun,
    store: RunStore,
    *,
    on_progress: OnProgress | None = None,
    protocol: Protocol | str = DEFAULT_PROTOCOL,
    progress_every: int = PROGRESS_EVERY,
    cancelled: Callable[[], bool] = lambda: False,
    at_a_time: int = 1,
) -> RunRecord:
    """Make a run in a child process and store it, whatever becomes of it.

    A tracker that raises, hangs, breaks its contract, takes too much or dies gives a record with
    that status and the reason; only a request that cannot begin at all is an error. A run that
    `on_progress` stopped is not stored.

    Args:
        run: What to run.
        store: Where to keep it; an earlier run of the same id is replaced.
        on_progress: Told of the partial metrics; may stop the run.
        protocol: Protocol of the partial metrics.
        progress_every: Frames between two of them.
        cancelled: Asked many times a second; True ends the run at once, as stopped.
        at_a_time: Runs that share this machine; the default memory limit is divided among them.

    Returns:
        The record.

    Raises:
        DynslamError: The request names something unknown or unfit, something other than the
            tracker's own code raised (an image, a mask or a file that cannot be read), the store
            cannot be written, or what a run needs broke (`InfrastructureError`); nothing is stored
            then.
    """
    if isinstance(run, RunSpec):
        resolved = resolve(run)
    else:
        resolved = run
        check_unchanged(resolved)
    started = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
    clock = time.perf_counter()

    def report(message: dict[str, Any]) -> bool:
        if on_progress is None:
            return True
        partial_results = {key: value for key, value in message.items() if key != "type"}
        return on_progress(resolved.run_id, partial_results)

    with store.work_folder(resolved.run_id) as work_folder:
        # a child makes the run; it logs each frame in the work folder
        job = _job(resolved, work_folder, get_protocol(protocol), progress_every)
        tick = partial(bound_log, work_folder / LOG_FILE, LONGEST_YET)

        def watch(child: Child) -> ProcessEnd:
            limits = resolved.spec.limits
            return supervise(child, job, limits, report, cancelled, tick=tick, at_a_time=at_a_time)

        end = _watched(work_folder, watch)
        _check_has_outcome(resolved, end, work_folder)

        # its frames become the files of a stored run
        frames = _write_frames(resolved, work_folder)
        check_unchanged(resolved, begun=True)
        reads = read_reads(work_folder) if resolved.has_plugins_or_programs else None
        wall_s = time.perf_counter() - clock
        record = make_record(resolved, end, frames, reads, started, wall_s).normalised()
        if record.status != "stopped":
            store.add_sequence(
                record.sequence.part,
                timestamps_ns(resolved.sequence),
                resolved.sequence.ground_truth,
            )
            record = store.publish(work_folder, record)
    return record


def _job(
    run: ResolvedRun, work_folder: Path, protocol: Protocol, progress_every: int
) -> dict[str, Any]:
    """The message to the child: the run, and how to report partial metrics."""
    job = make_job(
        CHILD_ENTRY_POINT,
        work_folder,
        spec=run.spec.model_dump(mode="json"),
        protocol=protocol.model_dump(mode="json"),
        progress_every=progress_every,
        recorded=recording_options(run),
    )
    # of the listed plug-ins the child imports those that the run names
    plugins = plugins_of_run(run.spec.tracker, run.settings, run.segmentation, run.spec.sequence)
    job["environment"][ENVIRONMENT_VARIABLE] = plugins
    return job


def _check_has_outcome(run: ResolvedRun, end: ProcessEnd, work_folder: Path) -> None:
    """Check that a run is there and says something about its tracker.

    Raises:
        InfrastructureError: Its work folder was removed.
        RunError: What was asked for cannot be, or something else than the tracker's code raised.
    """
    if not (work_folder / FRAMES_FILE).is_file():
        raise InfrastructureError(
            f"{work_folder} was removed while the run was made",
            "leave the results folder alone; nothing is stored, the same command goes on from there",
        )
    if end.refused:
        raise RunError(
            f"{run.tracker.id} cannot run on {run.sequence.id}: {end.reason}",
            "nothing is stored",
        )


def _write_frames(run: ResolvedRun, work_folder: Path) -> FrameLog:
    """Write the table of frames and the online trajectory in place of the child's log of frames.

    Returns:
        The frames, as far as the run came.

    Raises:
        InfrastructureError: They cannot be written.
    """
    with translate_errors(
        InfrastructureError, f"cannot write {work_folder}", "the run is not stored"
    ):
        bound_log(work_folder / LOG_FILE, LONGEST_LOG)
        frames = FrameLog.read(work_folder / FRAMES_FILE)
        title = f"{run.tracker.id} on {run.sequence.id}, seed {run.spec.seed}, online"
        frames.write(work_folder, title, exact_stamps(run.sequence))
        (work_folder / FRAMES_FILE).unlink()  # it fails where the folder was removed after all
    return frames


def recording_options(run: ResolvedRun) -> dict[str, Any] | None:
    """Options with which the child records what plug-ins and programs read; None for a run without such."""
    if not run.has_plugins_or_programs:
        return None
    plugin = None if run.base_folders.plugin is None else str(run.base_folders.plugin)
    return {"plugin": plugin, "work": str(run.base_folders.work), "packages": run.plugin_packages}


def read_reads(work_folder: Path) -> Reads | None:
    """Take the record of what the child read out of the run's folder; None where the child was killed before."""
    file = work_folder / READS_FILE
    if not file.is_file():
        return None
    reads = Reads.read(file)
    file.unlink()
    return reads


def _watched(work_folder: Path, watch: Callable[[Child], ProcessEnd]) -> ProcessEnd:
    """Run in a child process until it ends; when its fork server dies, run it again with a fork server of its own.

    No other run is there then. If that server dies, too, it is this run that has killed it: the run
    has crashed.

    Args:
        work_folder: Its work folder, which is emptied before each try.
        watch: Has a child make the run, and says how it ended.

    Raises:
        InfrastructureError: See `supervise`.
    """
    _empty(work_folder)
    with contextlib.suppress(ServerDiedError):
        return watch(Child())
    _empty(work_folder)
    with contextlib.closing(ForkServer()) as server_of_run:
        try:
            return watch(Child(server_of_run))
        except ServerDiedError as error:
            if not error.where:
                raise
            reason = f"the fork server was killed twice, the second time with this run alone{error.where}"
            return ProcessEnd("crashed", reason)


def _empty(work_folder: Path) -> None:
    """Leave in a work folder an empty log of frames and nothing else."""
    with translate_errors(
        InfrastructureError,
        f"cannot write {work_folder}",
        "check the free space; nothing is stored",
    ):
        for path in work_folder.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
        (work_folder / FRAMES_FILE).touch()
