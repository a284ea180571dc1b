"""Error and cost evaluations of every flow and every label search, as Markdown tables.

    PYTHONPATH=. python tests/benchmarks/flow_accuracy.py [--budgets 48 64 96 192 384] [--dense]

Sparse: share of all tracks (valid or not) within 1.5 and 3 px of the truth, by the length of the
true motion. With ``--dense``: the dense flow on the KITTI pair. Every row uses the default settings
but for what it names.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from command_line import parser_of
from flow_data import DENSE_SEARCHES, Pair, kitti, lengths, real, synthetic

from dynslam_bench.flow.dense_flow import DenseDaisyFlow
from dynslam_bench.flow.opencv import DisFlow
from dynslam_bench.flow.registry import build_flow
from dynslam_bench.flow.settings import DenseFlowSettings, FlowSettings

KINDS = ("translation", "scale", "rotation", "similarity", "homography", "foreground")
SEARCHES = ("emfoa+propagation", "patchmatch", "emfoa", "mfo", "emfoa-literal", "random")
CLASSES = ((0, 20), (20, 60), (60, np.inf))
FEWEST = 100
SEEDS = 10


def kitti_pair() -> Pair:
    """The KITTI pair at ORB-like points that have ground truth."""
    gray, flow, known = kitti()
    found = cv2.goodFeaturesToTrack(gray[0], 3000, 0.003, 5, mask=known.astype(np.uint8) * 255)[
        :, 0
    ]
    xy = found[known[found[:, 1].astype(int), found[:, 0].astype(int)]].astype(np.float32)
    truth = xy + flow[xy[:, 1].astype(int), xy[:, 0].astype(int)]
    inside = ((truth >= 0) & (truth < gray[0].shape[::-1])).all(axis=1)
    return Pair("KITTI", *gray, xy[inside], truth[inside])


def errors(settings: FlowSettings, pairs: Sequence[Pair]) -> tuple[np.ndarray, np.ndarray, float]:
    """End-point errors, true motions and mean evaluations a point."""
    flow = build_flow(settings)
    error = []
    spent = 0.0
    for pair in pairs:
        result = flow.track(
            flow.prepare(pair.reference), flow.prepare(pair.target), pair.points, seed=0
        )
        error.append(np.hypot(*(result.xy - pair.truth).T))
        spent += result.stats["evaluations"]
    motion = lengths(pairs)
    return np.concatenate(error), motion, spent / len(motion)


def cells(error: np.ndarray, motion: np.ndarray) -> list[str]:
    """``% < 1.5 px / % < 3 px / median`` for each class of motion."""
    row = []
    for low, high in CLASSES:
        e = error[(motion >= low) & (motion < high)]
        good = f"{100 * (e < 1.5).mean():.1f} / {100 * (e < 3).mean():.1f} / {np.median(e):.2f}"
        row.append(good if len(e) >= FEWEST else "-")
    return row


def sparse_table(sets: dict[str, list[Pair]], budgets: Sequence[int]) -> None:
    """One table a data set: all methods, all searches at all budgets."""
    rows = [
        ("Lucas-Kanade, 4 levels", FlowSettings(method="lucas-kanade")),
        ("DIS medium", FlowSettings(method="dis")),
    ]
    rows += [
        (f"{search}, {budget}", FlowSettings(search=search, budget=budget))
        for search in SEARCHES
        for budget in budgets
    ]
    for name, pairs in sets.items():
        motion = lengths(pairs)
        sizes = ", ".join(
            str(int(((motion >= low) & (motion < high)).sum())) for low, high in CLASSES
        )
        print(f"\n### {name}: {len(pairs)} pairs, tracks by class {sizes}\n")
        print(
            "| method, budget | < 20 px | 20-60 px | > 60 px | evaluations a point |\n| --- | --- | --- | --- | --- |"
        )
        for label, settings in rows:
            error, moved, spent = errors(settings, pairs)
            star = " (default)" if settings == FlowSettings() else ""
            print(
                f"| {label}{star} | {' | '.join(cells(error, moved))} | {spent:.0f} |", flush=True
            )


def kinds_table(pairs: list[Pair]) -> None:
    """The default flow and Lucas-Kanade by kind of warp."""
    print(
        "\n### Warps by kind, % < 1.5 px\n\n| kind | default | Lucas-Kanade |\n| --- | --- | --- |"
    )
    for kind in KINDS:
        mine = [pair for pair in pairs if pair.name == kind]
        row = [
            100 * (errors(s, mine)[0] < 1.5).mean()
            for s in (FlowSettings(), FlowSettings(method="lucas-kanade"))
        ]
        print(f"| {kind} | {row[0]:.1f} | {row[1]:.1f} |", flush=True)


def dense_table() -> None:
    """Dense flow of the KITTI pair: means over `SEEDS` seeds, with standard deviations."""
    gray, truth, known = kitti()
    print(
        "\n### Dense, KITTI pair\n\n| method | median px | % > 3 px | consistent % | evaluations |"
    )
    print("| --- | --- | --- | --- | --- |")
    for preset in ("ultrafast", "fast", "medium"):
        flow = DisFlow(FlowSettings(method="dis", dis_preset=preset)).dense(*gray)
        error = np.linalg.norm(flow - truth, axis=2)[known]
        print(f"| DIS {preset} | {np.median(error):.2f} | {100 * (error > 3).mean():.1f} | - | 0 |")
    for name, settings in (
        DENSE_SEARCHES | {"patchmatch": DenseFlowSettings(search="patchmatch")}
    ).items():
        dense = DenseDaisyFlow(settings)
        images = [dense.prepare(image) for image in gray]
        rows = []
        for seed in range(SEEDS):
            result = dense.flow(*images, seed=2 * seed)  # the way back takes the next one
            error = np.linalg.norm(result.flow - truth, axis=2)[known]
            shares = (error > 3).mean(), result.valid[known].mean()
            rows.append([np.median(error), *(100 * share for share in shares), result.evaluations])
        *columns, spent = zip(np.mean(rows, axis=0), np.std(rows, axis=0, ddof=1), strict=True)
        cells = [f"{mean:.1f} +- {deviation:.1f}" for mean, deviation in columns]
        print(f"| DAISY Filter Flow, {name} | {' | '.join(cells)} | {spent[0]:.0f} |", flush=True)


def main() -> None:
    """Print all tables."""
    options = parser_of(None, budgets=[48, 64, 96, 192, 384], dense=False).parse_args()
    if options.dense:
        dense_table()
        return
    warps = synthetic(KINDS, 6)
    sparse_table(
        {
            **{
                "Real frames (fr1_xyz, fr1_rpy)": real("fr1_xyz", (1, 3, 8, 14), 6)
                + real("fr1_rpy", (1, 2, 3, 5), 2),
                "Real frames (Bonn crowd)": real("bonn", (1, 5, 10, 15), 12),
            },
            "Synthetic warps": warps,
            "KITTI pair": [kitti_pair()],
        },
        options.budgets,
    )
    kinds_table(warps)


if __name__ == "__main__":
    main()
