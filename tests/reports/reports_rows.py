"""Rows and tables of reports as the tests make and read them."""

import csv

from dynslam_bench.evaluation.protocol import get_protocol
from dynslam_bench.reports.model.row import RunRow

PROTOCOL = get_protocol("tum-rgbd/v1")


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def row(tracker="a", sequence="s", error=0.1, **changes):
    base = dict(
        run_id="r", kind="run here", tracker=tracker, label=tracker.upper(), sequence=sequence, protocol_id="p",
        protocol_digest="d", metrics={"ate_rmse_m": error, "rpe_1s_trans_rmse_m": error / 2}, hold_last_pose_ate_m=error,
        static_camera_ate_rmse_m=0.3, coverage=1.0, n_frames=60, n_processed=60, n_tracked=60,
    )  # fmt: skip
    return RunRow(**(base | changes))


def crashed(tracker="c", sequence="s", error=0.001, **changes):
    """A run that died at frame 20 of 60, with a tiny error until then."""
    done = dict(failed=True, status="crashed", n_processed=20, n_tracked=20, coverage=1 / 3, reason="boom")
    return row(tracker, sequence, error, **(done | changes))


def cell_of(table, name, column=1):
    return next(cells for cells in table.rows if cells[0].text == name)[column]
