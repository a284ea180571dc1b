"""Comparison of protocols: how much the protocol alone changes the numbers of one trajectory."""

from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from functools import partial
from typing import TypeVar

from dynslam_bench.core import EvaluationError
from dynslam_bench.evaluation.evaluate import Evaluation, evaluate, evaluate_loaded
from dynslam_bench.evaluation.protocol import PROTOCOLS, Alignment, Protocol, RPESpec
from dynslam_bench.geometry import LoadedTrajectory, Trajectory


@dataclass(frozen=True)
class ComparisonRow:
    """One number under one protocol.

    Attributes:
        metric: ``ATE`` or ``RPE``, each an RMSE of translations.
        label: What sets the row apart, e.g. ``SE(3)-aligned``.
        rmse_m: The error in metres, of a rate in m/s; None where it is not defined.
        pairs: Poses or pairs of poses that it is taken over.
        protocol: One-line description of the whole protocol.
        note: Why the number is missing, or for what it holds only; empty otherwise.
    """

    metric: str
    label: str
    rmse_m: float | None
    pairs: int
    protocol: str
    note: str = ""


P = TypeVar("P", Trajectory, LoadedTrajectory)


def compare_protocols(estimate: P, ground_truth: P) -> list[ComparisonRow]:
    """ATE under every alignment and RPE under every habit of the field, of one and the same trajectory.

    Args:
        estimate: Estimated camera-to-world poses, or a file of them as `evaluate_loaded` takes it.
        ground_truth: True poses, or a file of them.

    Raises:
        EvaluationError: The trajectory cannot be evaluated under `tum-rgbd/v1` either.
    """
    evaluation: Callable[..., Evaluation] = (
        evaluate if isinstance(estimate, Trajectory) else evaluate_loaded
    )
    score = partial(evaluation, estimate, ground_truth)
    # what cannot be scored under TUM's protocol has no rows: this raises
    score(_TUM)
    habits = (("ATE", ABSOLUTE), ("RPE", RELATIVE))
    return [
        _row(metric, label, score, protocol)
        for metric, labels in habits
        for label, protocol in labels
    ]


def agrees(row: ComparisonRow, printed: str) -> bool:
    """Whether a row is what was printed, to the last digit that was: 0.07326 is ``0.0733``.

    Args:
        row: A row of `compare_protocols`.
        printed: The number in metres (of a rate in m/s) as it was printed.

    Raises:
        EvaluationError: It is no number.
    """
    try:
        number = Decimal(printed)
        half_digit = Decimal(5).scaleb(int(number.as_tuple().exponent) - 1)
    except (InvalidOperation, ValueError):
        raise EvaluationError(
            f"'{printed}' is not a number in metres as it was printed, e.g. 0.0733"
        ) from None
    return row.rmse_m is not None and abs(Decimal(row.rmse_m) - number) <= half_digit


_TUM = PROTOCOLS["tum-rgbd/v1"]
_EVO = PROTOCOLS["evo-default"]


def _variant(
    base: Protocol, name: str, *rpe: RPESpec, alignment: Alignment | None = None
) -> Protocol:
    """A protocol with another id, other relative errors and, if it is given, another alignment."""
    return base.model_copy(
        update={"id": name, "rpe": rpe, "alignment": alignment or base.alignment}
    )


ABSOLUTE = (
    ("not aligned", _variant(_TUM, "tum-rgbd/none", alignment="none")),
    ("origin-aligned", _variant(_TUM, "tum-rgbd/origin", alignment="origin")),
    ("yaw-aligned", _variant(_TUM, "tum-rgbd/yaw", alignment="yaw")),
    ("SE(3)-aligned (TUM's ATE)", _variant(_TUM, "tum-rgbd/se3", alignment="se3")),
    ("Sim(3)-aligned", _variant(_TUM, "tum-rgbd/sim3", alignment="sim3")),
    ("evo_ape -a", PROTOCOLS["evo-as/v1-se3"]),
    ("evo_ape -as", PROTOCOLS["evo-as/v1"]),
    ("VSLAM-LAB", PROTOCOLS["vslam-lab"]),
    ("WildGS-SLAM, DROID-W", PROTOCOLS["droid-w/v1"]),
    ("MonST3R (90 frames)", _variant(PROTOCOLS["tum-dynamics-90/v1"], "tum-dynamics-90/v1")),
    ("at Bonn's camera, SE(3)", _variant(PROTOCOLS["bonn-camera/v1"], "bonn-camera/v1")),
    ("DROID-W on Bonn", PROTOCOLS["droid-w/v1-bonn"]),
)
RELATIVE = (
    ("TUM, 1 frame, fixed delta", _variant(_TUM, "tum-rgbd/1f", RPESpec(delta=1, unit="f"))),
    ("TUM, 1 s, fixed delta", _variant(_TUM, "tum-rgbd/1s", RPESpec(delta=1, unit="s"))),
    ("TUM, 1 s, as a rate (mm/s)", PROTOCOLS["tum-rgbd/v1-rate"]),
    ("MonST3R (90 frames), 1 frame", PROTOCOLS["tum-dynamics-90/v1"]),
    ("TUM's default, random pairs", PROTOCOLS["tum-rgbd/v1-random-pairs"]),
    ("evo_rpe, 1 frame", _EVO),
    (
        "evo_rpe, 30 frames",
        _variant(_EVO, "evo 30f", RPESpec(delta=30, unit="f", pairs="consecutive")),
    ),
    (
        "evo_rpe, 30 frames, all pairs",
        _variant(_EVO, "evo 30f all", RPESpec(delta=30, unit="f", pairs="all")),
    ),
)


def _row(
    metric: str, label: str, score: Callable[[Protocol], Evaluation], protocol: Protocol
) -> ComparisonRow:
    """The number under one protocol, or the reason why it is missing."""
    row = partial(ComparisonRow, metric, label, protocol=protocol.describe())
    try:
        result = score(protocol)
    except EvaluationError as error:
        return row(rmse_m=None, pairs=0, note=str(error))
    if metric == "ATE":
        note = f"means something for {protocol.only_for}* only" if protocol.only_for else ""
        return row(rmse_m=result.metrics["ate_rmse_m"], pairs=result.n_pairs, note=note)
    spec = protocol.rpe[0]
    rmse = result.metrics.get(spec.metric("trans"))
    note = "" if rmse is not None else f"the trajectory has no pair {spec.describe()} apart"
    return row(rmse_m=rmse, pairs=result.n_pairs_rpe[spec.key], note=note)
