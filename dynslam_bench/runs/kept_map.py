"""What is kept of the map at the end of a run."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dynslam_bench.contracts.map_outputs import MapOutputs
from dynslam_bench.core.errors import TrackerError
from dynslam_bench.envs.slam_env import SlamEnv
from dynslam_bench.slam.mapping.saved_map import MAP_FILE
from dynslam_bench.slam.outputs.map_files import write_keyframes_csv, write_ply

from .spec import RunSpec


@dataclass(frozen=True)
class KeptMap:
    """A run's map.

    Attributes:
        outputs: Keyframes and points; None if the tracker offers none.
        counts: ``keyframes``, ``map_points`` and ``maps`` for the record; None for what the tracker does not say.
        notes: What a reader should know of it.
    """

    outputs: MapOutputs | None
    counts: dict[str, Any] = field(default_factory=lambda: dict.fromkeys(("keyframes", "map_points", "maps")))
    notes: tuple[str, ...] = ()


def keep_map(env: SlamEnv, folder: Path, spec: RunSpec) -> KeptMap:
    """Write ``keyframes.csv``, ``map.ply`` and, if it was asked for, ``map.npz``.

    Raises:
        DynslamError: A file cannot be written.
    """
    not_saved = _save(env, folder, spec) if spec.save_map else ()
    outputs = env.map_outputs()
    if outputs is None:
        return KeptMap(None, notes=not_saved)
    write_keyframes_csv(folder / "keyframes.csv", outputs, env.exact_stamps)
    write_ply(folder / "map.ply", outputs)
    numbers = np.array([record.map for record in outputs.keyframes])
    maps = len(np.unique(numbers))
    counts = {"keyframes": len(outputs.keyframes), "map_points": len(outputs.positions), "maps": maps}
    apart = int(np.count_nonzero(numbers))
    met = (
        f"{maps} maps that never met: {apart} of {len(numbers)} keyframes lie in others than the first, whose place "
        "in it is unknown; frames tracked there count as lost, and no points of it are in map.ply"
    )
    return KeptMap(outputs, counts, (*not_saved, *([met] if maps > 1 else [])))


def _save(env: SlamEnv, folder: Path, spec: RunSpec) -> tuple[str, ...]:
    """Write the map; why that was not possible, if it was not."""
    start, stop = spec.frames_seen or (0, None)
    asked = spec.settings | {f"degrade.{kind}": strength for kind, strength in spec.degrade.items()}
    words = [f"{env.tracker_spec.id} on {env.sequence.id}", f"frames {start}:{'' if stop is None else stop}"]
    words += [f"stride {spec.stride}"] * (spec.stride != 1) + [f"seed {spec.seed}"]
    words += [f"{name}={value}" for name, value in asked.items()]
    try:
        env.save_map(folder / MAP_FILE, ", ".join(words))
    except TrackerError as error:
        return (f"no {MAP_FILE}: {error}",)
    return ()
