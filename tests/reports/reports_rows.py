"""Rows and tables of reports as the tests make and read them."""

import csv
import json

from dynslam_bench.core.records import digest
from dynslam_bench.evaluation.protocol import get_protocol
from dynslam_bench.reports.model.row import RunRow

PROTOCOL = get_protocol("tum-rgbd/v1")


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def page_data(folder, name):
    """What a side file of a report hands to its page."""
    text = (folder / "data" / f"{name}.js").read_text()
    return json.loads(text[text.index(",", text.index("keep(")) + 1 : text.rindex(")")])


SEQUENCE = {"block", "tags", "content", "noise", "duration_s"}
TRACKER = {"label", "provenance", "ranked", "deterministic"}


def row(tracker="a", sequence="s", error=0.1, variant=None, **changes):
    """A row of one run that ended; `variant` holds settings, device and threads."""
    info, spec = ({name: changes.pop(name) for name in names & set(changes)} for names in (SEQUENCE, TRACKER))
    info["block"] = digest([info.get("block") or sequence, changes.get("frames")], 16)
    settings = dict(variant or {})
    changes |= {name: settings.pop(name) for name in ("device", "threads") if name in settings}
    base = dict(
        run_id=digest([tracker, sequence, error, str(changes), str(info), settings], 16), status="ok",
        sequence=dict(id=sequence, part="0" * 16, frames=60, duration_s=2, fps=30, ground_truth=True) | info,
        tracker=dict(id=tracker, label=tracker.upper()) | spec, overrides=settings, settings=settings,
        protocol_id="p", protocol_digest="d", metrics={"ate_rmse_m": error, "rpe_1s_trans_rmse_m": error / 2},
        hold_last_pose_ate_m=error, static_camera_ate_rmse_m=0.3, coverage=1.0, n_frames=60, n_processed=60,
        n_tracked=60,
    )  # fmt: skip
    return RunRow(**(base | changes))


def crashed(tracker="c", sequence="s", error=0.001, **changes):
    """A run that died at frame 20 of 60, with a tiny error until then."""
    done = dict(status="crashed", n_processed=20, n_tracked=20, coverage=1 / 3, reason="boom")
    return row(tracker, sequence, error, **(done | changes))


def cell_of(table, name, column=1):
    return next(cells for cells in table.rows if cells[0].text == name)[column]


def columns_of(table, *names):
    """The cells of some columns of a table."""
    headings = [column.name for column in table.columns]
    return [[cells[headings.index(name)] for cells in table.rows] for name in names]
