"""Rows and tables of reports as the tests make and read them."""

import csv
import json

from dynslam_bench.core.records import digest
from dynslam_bench.evaluation.protocol import get_protocol
from dynslam_bench.reports.model.row import RunRow
from dynslam_bench.runs.record import SequenceInfo, TrackerInfo

PROTOCOL = get_protocol("tum-rgbd/v1")


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def page_data(folder, name):
    """What a side file of a report hands to its page."""
    text = (folder / "data" / f"{name}.js").read_text()
    return json.loads(text[text.index(",") + 1 : text.rindex(")")])


def row(tracker="a", sequence="s", error=0.1, block=None, provenance="external", tags=(), content="", noise=None, **changes):
    frames = changes.get("frames")
    info = SequenceInfo(
        id=sequence, part="0" * 16, block=digest([block] if block else [sequence, frames], 16), frames=60, duration_s=2,
        fps=30, ground_truth=True, tags=list(tags), content=content, noise=noise,
    )  # fmt: skip
    base = dict(
        run_id=digest([tracker, sequence, error, changes], 16), status="ok", sequence=info, protocol_id="p",
        tracker=TrackerInfo(id=tracker, label=tracker.upper(), provenance=provenance), protocol_digest="d",
        metrics={"ate_rmse_m": error, "rpe_1s_trans_rmse_m": error / 2}, hold_last_pose_ate_m=error,
        static_camera_ate_rmse_m=0.3, coverage=1.0, n_frames=60, n_processed=60, n_tracked=60,
    )  # fmt: skip
    return RunRow(**(base | changes))


def crashed(tracker="c", sequence="s", error=0.001, **changes):
    """A run that died at frame 20 of 60, with a tiny error until then."""
    done = dict(status="crashed", n_processed=20, n_tracked=20, coverage=1 / 3, reason="boom")
    return row(tracker, sequence, error, **(done | changes))


def cell_of(table, name, column=1):
    return next(cells for cells in table.rows if cells[0].text == name)[column]
