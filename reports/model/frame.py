"""All rows as one pandas frame: what CSV is written from, and what own analyses start with."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from dynslam_bench.core.toml import assignments

from .row import RunRow

if TYPE_CHECKING:
    import pandas as pd

_TEXT = ["run_id", "kind", "tracker", "label", "settings", "provenance", "sequence", "column_id", "frames", "split"]
_TEXT += ["repeat", "status", "ending", "study", "protocol_id", "protocol_digest", "trajectory", "segmentation"]
_WHOLE = ["seed", "offset", "n_frames", "n_processed", "n_tracked", "noise"]
_FLAGS = ["ranked", "failed", "cached", "seen_in_training"]
_NUMBERS = ["coverage", "score_m", "held_ate_m", "final_ate_m", "static_camera_ate_rmse_m", "frame_ms"]
_NUMBERS += ["real_time_factor", "peak_memory_mb", "mask_iou", "epipolar_skipped", "rotation_uncertainty_deg"]
_OWN = ("label", "sequence", "settings")


def rows_frame(rows: Sequence[RunRow], columns: Mapping[str, str], labels: Mapping[str, str]) -> pd.DataFrame:
    """Rows as a frame.

    Args:
        rows: One a run.
        columns: Column id to the name of its sequence, see `name_columns`.
        labels: Variant key to the name of the tracker in tables, see `make_labels`.

    Returns:
        One line a run, ordered by label, sequence and repeat; whatever is missing is ``pd.NA``. ``string`` columns:
        run_id, kind (``run here``, ``imported``), tracker, label, settings (what sets the variant apart,
        ``name=value; ...``), provenance, sequence (name of the column in tables), column_id, frames, split, repeat,
        status, ending (of a failed run), study (of which the run is a trial), protocol_id, protocol_digest, trajectory
        (``online``, ``final``: whose errors they are), segmentation.
        ``Int64``: seed, offset, noise (missing for the sequence's own), n_frames, n_processed, n_tracked. ``boolean``:
        ranked, failed, cached (whether stage times come from the stage cache), seen_in_training (whether the masks
        come from a network that was trained on the scene). ``Float64``: coverage and
        epipolar_skipped (shares, 0 to 1), score_m (the ATE in metres that ranks: lost frames held,
        failures as a static camera or worse), held_ate_m, final_ate_m and static_camera_ate_rmse_m (metres), frame_ms
        (median, milliseconds), real_time_factor, peak_memory_mb (MB), mask_iou (0 to 1),
        rotation_uncertainty_deg (standard error in degrees of the alignment's rotation; above 10 the metrics
        ``ape_rot_*`` say nothing of the tracker), and every metric of the protocol under
        its own name, the unit at its end (``ate_rmse_m``, ``rpe_1s_rot_rmse_deg``; see `Evaluation`).
    """
    import pandas as pd

    ordered = sorted(rows, key=lambda r: (labels[r.variant_key], columns[r.column_id], r.repeat_key))
    metrics = sorted({name for row in rows for name in row.metrics} - set(_NUMBERS))
    kinds: dict[str, str] = dict.fromkeys(_TEXT, "string") | dict.fromkeys(_WHOLE, "Int64")
    kinds |= dict.fromkeys(_FLAGS, "boolean") | dict.fromkeys((*_NUMBERS, *metrics), "Float64")
    plain = [name for name in kinds if name not in {*_OWN, *metrics}]
    of_row = attrgetter(*plain)
    lines = [  # row by row: a hundred thousand of them lie far apart in memory
        (*_own(row, columns, labels), *map(row.metrics.get, metrics), *of_row(row)) for row in ordered
    ]
    values: Iterable[Sequence[Any]] = zip(*lines, strict=True) if lines else [()] * len(kinds)
    found = dict(zip([*_OWN, *metrics, *plain], values, strict=True))
    return pd.DataFrame({name: _array(found[name], kind) for name, kind in kinds.items()})


def _own(row: RunRow, columns: Mapping[str, str], labels: Mapping[str, str]) -> tuple[str, str, str]:
    """What a row alone does not know, under the names `_OWN`."""
    settings = "; ".join(assignments(row.variant))
    return labels[row.variant_key], columns[row.column_id], settings


def _array(values: Sequence[Any], kind: str) -> Any:
    """A column of a kind; numbers by way of numpy, which takes a tenth of the time."""
    import pandas as pd

    listed: Any = np.array(values, dtype=np.float64) if kind == "Float64" else list(values)
    return pd.Series(listed, dtype=kind).array
