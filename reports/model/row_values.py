"""What a row takes out of a run's record and its stored trajectories."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.records import digest
from dynslam_bench.evaluation.ate import ate_rmse_m
from dynslam_bench.evaluation.evaluate import Evaluation
from dynslam_bench.evaluation.never_move import never_move
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.runs.storage.record import RunRecord
from dynslam_bench.runs.storage.store import RunStore


def column_of(record: RunRecord) -> str:
    """What one column of a table is: content, camera, frames and stride.

    Records of older versions have no block; for them it is content and frames with the camera, if they name one.
    """
    camera = record.identity.get("camera")
    old = record.sequence.part + (f"-{digest(camera, 8)}" if camera else "")
    return record.sequence.block or old


def camera_words(record: RunRecord) -> str:
    """The camera in a few words, empty if the record does not name it."""
    camera = record.identity.get("camera")
    if not isinstance(camera, dict) or not {"width", "height", "fx", "fy"} <= camera.keys():
        return ""
    return "camera {width}x{height}, f {fx} {fy}".format(**{key: _short(value) for key, value in camera.items()})


def _short(value: object) -> str:
    """A number, or whatever else a record of somebody else's holds in its place."""
    return f"{value:g}" if isinstance(value, int | float) else str(value)


def never_move_error(
    store: RunStore, record: RunRecord, protocol: Protocol, evaluation: Evaluation | None
) -> float | None:
    """What a static camera scores under the protocol's alignment; None without ground truth."""
    if evaluation is not None and "static_camera_ate_rmse_m" in evaluation.metrics:
        return evaluation.metrics["static_camera_ate_rmse_m"]
    try:
        truth = store.ground_truth(record.sequence.part)
        if truth is None:
            return None
        errors = never_move(truth, store.timestamps(record.sequence.part), protocol.max_dt)
    except DynslamError:
        return None
    return errors["first_rmse_m" if protocol.alignment in ("none", "origin") else "constant_rmse_m"]


def held_error(
    store: RunStore, record: RunRecord, protocol: Protocol, evaluation: Evaluation | None, still: float | None
) -> float | None:
    """The ATE with every lost frame counted as not having moved since the last tracked one; None without evaluation.

    Where the poses cannot be held, since they belong to no input frames, a trajectory with lost frames counts at least
    as a static camera (`still`).
    """
    if evaluation is None:
        return None
    error = evaluation.metrics["ate_rmse_m"]
    if evaluation.coverage == 1.0:
        return error
    unheld = error if record.coverage >= 1.0 else max(error, still or 0.0)
    try:
        trajectory, truth = (
            store.trajectory(record.run_id, protocol.trajectory),
            store.ground_truth(record.sequence.part),
        )
        if trajectory is None or truth is None:
            return unheld
        stamps = store.timestamps(record.sequence.part)
        return ate_rmse_m(trajectory, truth, protocol, held_at=stamps)
    except DynslamError:
        return unheld


def variant_of(record: RunRecord) -> dict[str, Any]:
    """What sets runs of one tracker apart besides sequence and repeat."""
    variant: dict[str, Any] = dict(sorted(record.asked.items()))
    if record.kind == "run":
        variant |= {"device": record.device, "threads": record.threads}
    if record.realtime:
        machine = record.machine
        variant["realtime"] = f"{machine.cpu}, {machine.cores} cores" if machine is not None else True
    if record.drop_share:
        variant["drop_share"] = record.drop_share
    variant |= {f"degrade.{name}": value for name, value in sorted(record.degrade.items())}
    return variant


def part_options(record: RunRecord) -> list[str]:
    """The same as options of the command line."""
    options = []
    if record.frames is not None:
        start, stop = record.frames
        options += ["--frames", f"{start}:{'' if stop is None else stop}"]
    return options + (["--stride", str(record.stride)] if record.stride != 1 else [])


def command_line(command: list[str]) -> str:
    """The command line as one would type it."""
    if not command:
        return ""
    head = Path(command[0]).name
    return shlex.join(["dynslam-bench" if head in ("__main__.py", "dynslam-bench") else command[0], *command[1:]])


def machine_words(record: RunRecord) -> str:
    """Computer and versions in words."""
    parts = []
    if record.machine is not None:
        machine = record.machine
        parts.append(f"{machine.cpu}, {machine.cores} cores, {machine.memory_gb:g} GB, {machine.system}")
        if machine.gpu:
            parts.append(machine.gpu)
    parts += [f"{name} {version}" for name, version in record.versions.items()]
    if record.git is not None:
        parts.append(f"git {record.git.revision[:10]}{' (changed)' if record.git.dirty else ''}")
    return "; ".join(parts)
