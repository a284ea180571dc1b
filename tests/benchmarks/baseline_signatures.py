"""Do the re-implemented systems fail and survive where the published ones do?

Reads the results folder of ``dynslam-bench bench dynamic`` and prints, in Markdown, each system's
class on each rendered replica beside the class that published figures put it in.

    dynslam-bench bench dynamic --results results
    python tests/benchmarks/baseline_signatures.py results

Each instance of a replica is a row of its own. Its repeats (start offsets, sensor-noise seeds,
seeds) are one cell: the median counts, the range stands beside it.

Measured class (medians over the repeats):
  fails     ATE >= 0.5 x that of a camera that never moves, or coverage < 80 %, or the run did not
  end; survives  ATE <= 3 x that of `mask-rcnn` with exact masks on the same replica;
  between   neither.
Where a replica moves so little that both hold (half of never-move is below three times the
reference system's error: the rotating and the standing camera), the cell survives: what is as good
as exact masks has not failed.

Published class, from the product's own table of reported numbers, by the same rule: a cell is
  fails     if all published ATEs of the system on the recorded sequence are >= 0.5 x never-move
  there; survives  if all are <= 3 x the reference system's, which is DynaSLAM N (Mask R-CNN's masks
  alone), or where that is
            not published the best published ATE of DynaSLAM;
and clear if exactly one of the two holds. Sim(3)-aligned numbers and ablations do not count.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.evaluation.protocol import get_protocol
from dynslam_bench.reports.model.load import load_runs, open_stores
from dynslam_bench.reports.model.published import published, static_camera_errors
from dynslam_bench.runs import DEFAULT_PROTOCOL, FAILED
from dynslam_bench.trackers.registry import TRACKERS

FAILS = "fails"
SURVIVES = "survives"
BETWEEN = "between"
REFERENCES = (("DynaSLAM N",), ("DynaSLAM N+G", "DynaSLAM"))
FAITHFUL = ("faithful-code", "faithful-paper")
EXACT = "mask-rcnn with exact masks"


def classify(
    ate: float,
    coverage: float,
    static_camera: float,
    reference: float,
    broken: bool,
) -> str:
    """The measured class of a cell; where both hold it survives."""
    if broken or not np.isfinite(ate) or coverage < 0.8:
        return FAILS
    if ate <= 3 * reference:
        return SURVIVES
    return FAILS if ate >= 0.5 * static_camera else BETWEEN


def recorded(replica: str) -> str:
    """The recorded sequence behind a replica: ``synthetic/walking_xyz?scene=3`` -> ``tum/fr3/walking_xyz``."""
    return "tum/fr3/" + replica.removeprefix("synthetic/").partition("?")[0]


def published_values(names: Sequence[str], sequence: str) -> list[float]:
    """Published ATEs in metres of systems of these names on a recorded sequence, SE(3) or not stated."""
    rows = published().query(
        "system in @names and sequence == @sequence and metric == 'ate_rmse_m'"
    )
    return rows.loc[rows["alignment"] != "Sim(3)", "value"].tolist()


def published_class(tracker: str, sequence: str) -> str | None:
    """The class that published figures put a system in; `between` if they are not clear, None if there are none."""
    values = published_values(TRACKERS.get(tracker).published_as, sequence)
    if not values:
        return None
    standstill = static_camera_errors().get((sequence, "ape_rmse"))
    reference = next(
        (min(found) for names in REFERENCES if (found := published_values(names, sequence))), None
    )
    fails = standstill is not None and min(values) >= 0.5 * standstill
    survives = reference is not None and max(values) <= 3 * reference
    if fails == survives:
        return BETWEEN
    return FAILS if fails else SURVIVES


def read_cells(folder: Path) -> pd.DataFrame:
    """Everything that the table needs of a suite's results: a row by (tracker, sequence), over its repeats.

    Returns:
        Medians of the ATE in metres (with its `low` and `high`), of the coverage, and of the ATE of
        a camera that never moves; whether any run is `broken`; provenance. The reference system is
        `EXACT`, others have default settings.
    """
    rows = []
    for run in load_runs(open_stores(folder), get_protocol(DEFAULT_PROTOCOL)).rows:
        if run.kind != "run" or run.degrade or run.drop_share or run.realtime:
            continue
        exact = run.tracker.id == "mask-rcnn" and run.overrides == {"segmentation.source": "oracle"}
        if exact or not run.overrides:
            rows.append(
                (
                    EXACT if exact else run.tracker.id,
                    run.sequence.id,
                    run.tracker.provenance,
                    run.metrics.get("ate_rmse_m"),
                    run.coverage,
                    run.static_camera_ate_rmse_m,
                    run.status in FAILED,
                )
            )
    names = ["tracker", "sequence", "provenance", "ate", "coverage", "static_camera", "broken"]
    frame = pd.DataFrame(rows, columns=names).astype({"ate": float, "static_camera": float})
    return frame.groupby(["tracker", "sequence"], sort=False).agg(
        provenance=("provenance", "first"), ate=("ate", "median"), low=("ate", "min"), high=("ate", "max"),
        coverage=("coverage", "median"), static_camera=("static_camera", "median"), broken=("broken", "any"),
    )  # fmt: skip


def report(folder: Path) -> str:
    """The whole Markdown text of a suite's results.

    Raises:
        DynslamError: The folder holds no runs, or not the reference system's.
    """
    cells = read_cells(folder)
    ates = cells["ate"].unstack()
    replicas = [name for name in ates if name.startswith("synthetic/")] if len(cells) else []
    reference = ates.reindex(index=[EXACT], columns=replicas).loc[EXACT]
    missing = [replica for replica in replicas if np.isnan(reference[replica])]
    if missing or not replicas:
        raise DynslamError(
            f"{folder} holds no run of mask-rcnn with exact masks on {missing[0] if missing else 'any replica'}",
            "run the suite 'dynamic', or mask-rcnn with --set segmentation.source=oracle",
        )
    standstill = cells["static_camera"].unstack().loc[EXACT]
    if "never-move" in ates.index:
        standstill = standstill.fillna(ates.loc["never-move"])
    lines = [
        "| replica | never-move m | exact masks m | fails from m | survives up to m |",
        "| --- | --- | --- | --- | --- |",
    ]
    for replica in replicas:
        still = standstill[replica]
        exact = reference[replica]
        lines.append(
            f"| {short(replica)} | {still:.3f} | {exact:.4f} | {0.5 * still:.4f} | {3 * exact:.4f} |"
        )
    lines += [
        "",
        "| system | provenance | replica | ATE m | coverage | measured | published | verdict |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    clear = 0
    misses = []
    by_name = {
        (key, place): cell
        for (key, place), cell in cells.iterrows()
        if key != EXACT and place in replicas
    }
    order = sorted(
        by_name,
        key=lambda key: (by_name[key].provenance not in FAITHFUL, key[0], replicas.index(key[1])),
    )
    for tracker, replica in order:
        cell = by_name[tracker, replica]
        expected = published_class(tracker, recorded(replica))
        if expected is None:
            continue
        measured = classify(
            cell.ate, cell.coverage, standstill[replica], reference[replica], cell.broken
        )
        verdict = (
            "not clear" if expected == BETWEEN else "match" if measured == expected else "**miss**"
        )
        if cell.provenance in FAITHFUL and expected != BETWEEN:
            clear += 1
            if measured != expected:
                misses.append(
                    f"- {tracker} on {short(replica)}: {measured} ({cell.ate:.4f} m), published {expected}"
                )
        elif verdict != "not clear":
            verdict += " (not counted)"
        spread = f" ({cell.low:.4f}-{cell.high:.4f})" if cell.high - cell.low >= 5e-5 else ""
        lines.append(
            f"| `{tracker}` | {cell.provenance} | {short(replica)} | {cell.ate:.4f}{spread} "
            f"| {100 * cell.coverage:.0f} % | {measured} | {expected} | {verdict} |"
        )
    matched = clear - len(misses)
    share = f"{100 * matched / clear:.0f} %" if clear else "-"
    lines += [
        "",
        f"Clear cells of faithful systems that match: {matched} of {clear} ({share}; the bar is 75 %).",
    ]
    return "\n".join([*lines, "", "Misses:", "", *misses] if misses else lines)


def short(replica: str) -> str:
    """``synthetic/walking_xyz?scene=0&frames=600`` -> ``walking_xyz``; other scenes keep their number."""
    return replica.removeprefix("synthetic/").partition("&")[0].removesuffix("?scene=0")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "results", type=Path, help="folder that 'dynslam-bench bench dynamic' wrote"
    )
    try:
        print(report(parser.parse_args().results))
    except DynslamError as error:
        raise SystemExit(str(error)) from error
