"""The evaluation protocol: everything besides the two trajectories that an error depends on.

The same trajectory scores tenfold different numbers under two options of one official script;
therefore a metric is stored with its protocol's digest, and tables refuse to mix digests.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from dynslam_bench.core import EvaluationError, did_you_mean
from dynslam_bench.core.records import digest

Alignment = Literal["none", "origin", "se3", "sim3", "yaw"]
DeltaUnit = Literal["f", "s", "m", "rad", "deg"]
PairMode = Literal["tum-fixed", "tum-random", "consecutive", "all"]
Truth = Literal["as-is", "bonn-camera", "bonn-droid-w"]

MONOCULAR = "tum-rgbd/v1-sim3"
"""Id of the protocol for trackers whose scale is unknown: that of TUM with a Sim(3) alignment."""
_PHRASES = {
    "none": "no alignment",
    "origin": "origin-aligned",
    "se3": "SE(3)-aligned",
    "sim3": "Sim(3)-aligned",
    "yaw": "yaw- and position-aligned",
    "exclude": "lost frames excluded",
    "hold": "lost frames held at the last pose",
    "bonn-camera": "Bonn's truth moved to the camera",
    "bonn-droid-w": "Bonn's truth as DROID-W corrects it",
    "tum-fixed": "TUM pairs",
    "consecutive": "consecutive pairs",
    "all": "all pairs",
}
"""Words for the choices of a protocol in its description."""


class _Frozen(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class RPESpec(_Frozen):
    """Choice of the pairs of poses that the relative pose error (the paper's Eq. 26) is taken over.

    Attributes:
        delta: Distance between the poses of a pair; ignored by ``tum-random``.
        unit: Its unit: ``f`` frames, ``s`` seconds, ``m`` metres of path, ``rad`` or ``deg`` of
            rotation. Pairs of evo's are taken over frames alone.
        pairs: ``tum-fixed``: for every pose the one closest to `delta` further along the estimate,
            unless that is the last pose. ``tum-random``: `max_pairs` seeded random pairs (every
            pair of a trajectory shorter than the square root of that). ``consecutive`` and ``all``:
            evo's non-overlapping and overlapping pairs.
        max_pairs: At most so many pairs in the two TUM modes, a seeded sample of them; 0 for all.
        rate: Whether each error is divided by the time between its two poses: m/s and degrees/s.
    """

    delta: float = Field(default=1.0, gt=0)
    unit: DeltaUnit = "f"
    pairs: PairMode = "tum-fixed"
    max_pairs: int = Field(default=10000, ge=0)
    rate: bool = False

    @model_validator(mode="after")
    def _whole_frames(self) -> RPESpec:
        if self.unit == "f" and self.delta != round(self.delta):
            raise ValueError(f"a delta in frames is a whole number, got {self.delta:g}")
        if self.pairs in ("consecutive", "all") and self.unit != "f":
            raise ValueError(f"{self.pairs} pairs are taken over frames, not over '{self.unit}'")
        if self.rate and self.unit != "s":
            raise ValueError(f"a rate is taken over seconds, not over '{self.unit}'")
        return self

    @property
    def key(self) -> str:
        """Part of the metrics' names: ``1s`` in ``rpe_1s_trans_rmse_m``, or ``random``."""
        if self.pairs == "tum-random":
            return "random"
        return f"{self.delta:g}{self.unit}{'_rate' if self.rate else ''}"

    def unit_of(self, part: str) -> str:
        """Unit of the error as metrics name it: m, deg, m_per_s or deg_per_s."""
        unit = "m" if part == "trans" else "deg"
        return f"{unit}_per_s" if self.rate else unit

    def metric(self, part: str) -> str:
        """Name of the metric, e.g. ``rpe_1s_trans_rmse_m``."""
        return f"rpe_{self.key}_{part}_rmse_{self.unit_of(part)}"

    def describe(self) -> str:
        """For example ``1 s (TUM pairs)``."""
        if self.pairs == "tum-random":
            return f"{self.max_pairs} random pairs" if self.max_pairs else "all pairs"
        unit: str = self.unit
        if unit == "f":
            unit = "frame" if self.delta == 1 else "frames"
        rate = ", as a rate" if self.rate else ""
        return f"{self.delta:g} {unit} ({_PHRASES[self.pairs]}{rate})"


class Protocol(_Frozen):
    """A frozen evaluation protocol.

    Attributes:
        id: Name and version.
        max_dt: Largest time difference in seconds between an estimated and a true pose.
        strict: True for ``|dt| < max_dt``, False for ``<=``.
        one_to_one: True for TUM's greedy one-to-one association; False for evo's: every pose of the
            shorter trajectory takes its nearest neighbour in the other, which may be taken
            repeatedly. Of a file evo's takes all lines with the same stamp, TUM's the last.
        alignment: How the estimate is moved onto the ground truth before absolute errors are taken:
            ``none``, ``origin`` (first associated pose), ``se3`` and ``sim3`` (least squares over
            the positions), ``yaw`` (translation and rotation about the world's z axis).
        rpe: The relative pose errors.
        segments_m: Lengths of KITTI's segments in metres; empty for none.
        trajectory: Whether the online or the final trajectory of a run is evaluated.
        lost_frames: ``exclude``: frames without a tracked pose take no part. ``hold``: the camera
            counts as not having moved since the last tracked frame.
        truth: ``as-is``; ``bonn-camera``: Bonn's positions moved from the markers to the camera
            (18.6 mm); ``bonn-droid-w``: Bonn's poses as WildGS-SLAM and DROID-W correct them, which
            makes them 5.6 % smaller.
        every: Only every so many of the frames that have a true pose are compared.
        most_frames: At most so many of those, the first ones; 0 for all.
        only_for: Beginning of the ids of the sequences that it holds for; empty for all.
    """

    id: str
    max_dt: float = Field(default=0.02, ge=0)
    strict: bool = True
    one_to_one: bool = True
    alignment: Alignment = "se3"
    rpe: tuple[RPESpec, ...] = ()
    segments_m: tuple[float, ...] = ()
    trajectory: Literal["online", "final"] = "online"
    lost_frames: Literal["exclude", "hold"] = "exclude"
    truth: Truth = "as-is"
    every: int = Field(default=1, ge=1)
    most_frames: int = Field(default=0, ge=0)
    only_for: str = ""

    def digest(self) -> str:
        """Twelve hexadecimal digits that stand for every field; stored with every metric.

        What came after the first protocols counts where it is used only: digests that are stored
        stay what they were.
        """
        return _digest(self)

    @property
    def thins(self) -> bool:
        """Whether only some of the frames are compared."""
        return self.every > 1 or self.most_frames > 0

    def check_sequence(self, sequence: str) -> None:
        """Refuse a sequence that the protocol does not hold for.

        Raises:
            EvaluationError: The protocol does not hold for the sequence.
        """
        if not sequence.startswith(self.only_for):
            raise EvaluationError(
                f"protocol {self.id} holds for {self.only_for}* only, not for '{sequence}'"
            )

    @property
    def finds_scale(self) -> bool:
        """Whether the alignment finds the estimate's scale."""
        return self.alignment == "sim3"

    def check_scale(self, tracker: str, sensors: str) -> None:
        """Refuse poses of a camera alone, whose unit of length nobody knows, unless the alignment finds their scale.

        Args:
            tracker: Id of the tracker, for the message.
            sensors: What it looks at (`TrackerSpec.sensors`).

        Raises:
            EvaluationError: The tracker is monocular, and the alignment leaves the scale as it is.
        """
        if sensors == "rgb" and not self.finds_scale:
            raise EvaluationError(
                f"'{tracker}' is monocular: its scale is unknown, and protocol {self.id} aligns without scale",
                f"score it under a protocol with Sim(3) alignment: --protocol {MONOCULAR}",
            )

    def describe(self) -> str:
        """One line for captions: everything that the numbers depend on."""
        less = "<" if self.strict else "<="
        association = "one-to-one" if self.one_to_one else "nearest"
        parts = [
            _PHRASES[self.alignment],
            f"|dt| {less} {self.max_dt:g} s {association}",
        ]
        if self.rpe:
            parts.append("RPE over " + " and ".join(spec.describe() for spec in self.rpe))
        if self.segments_m:
            lengths = ", ".join(f"{length:g}" for length in self.segments_m)
            parts.append(f"segments of {lengths} m")
        if self.truth != "as-is":
            parts.append(_PHRASES[self.truth])
        if self.thins:
            parts.append(f"every {self.every} matched frames, at most {self.most_frames or 'all'}")
        parts += [f"{self.trajectory} trajectory", _PHRASES[self.lost_frames]]
        return f"{self.id}: " + ", ".join(parts) + f" [{self.digest()}]"


PROTOCOLS: dict[str, Protocol] = {
    protocol.id: protocol
    for protocol in (
        Protocol(id="tum-rgbd/v1", rpe=(RPESpec(delta=1, unit="s"), RPESpec(delta=1, unit="f"))),
        # relative errors are taken under the alignment's scale, too
        Protocol(
            id=MONOCULAR,
            alignment="sim3",
            rpe=(RPESpec(delta=1, unit="s"), RPESpec(delta=1, unit="f")),
        ),
        # of systems that give a trajectory at their end only
        Protocol(
            id="tum-rgbd/v1-final",
            trajectory="final",
            rpe=(RPESpec(delta=1, unit="s"), RPESpec(delta=1, unit="f")),
        ),
        Protocol(id="tum-rgbd/v1-random-pairs", rpe=(RPESpec(pairs="tum-random"),)),
        Protocol(
            id="evo-default",
            max_dt=0.01,
            strict=False,
            one_to_one=False,
            alignment="none",
            rpe=(RPESpec(delta=1, unit="f", pairs="consecutive"),),
        ),
        # evo_ape tum -as and -a, at evo's own tolerance: the convention of most tables that were
        # made with evo
        Protocol(
            id="evo-as/v1",
            max_dt=0.01,
            strict=False,
            one_to_one=False,
            alignment="sim3",
            trajectory="final",
        ),
        Protocol(
            id="evo-as/v1-se3",
            max_dt=0.01,
            strict=False,
            one_to_one=False,
            alignment="se3",
            trajectory="final",
        ),
        # evo_ape -as with a tolerance of ten frames at 30 Hz, whatever the sensor
        Protocol(id="vslam-lab", max_dt=1 / 3, strict=False, one_to_one=False, alignment="sim3"),
        Protocol(
            id="kitti",
            alignment="origin",
            rpe=(RPESpec(delta=1, unit="f", pairs="all"),),
            segments_m=(100, 200, 300, 400, 500, 600, 700, 800),
        ),
        # drift in m/s, as several papers state it
        Protocol(id="tum-rgbd/v1-rate", rpe=(RPESpec(delta=1, unit="s", rate=True),)),
        Protocol(
            id="bonn-camera/v1",
            truth="bonn-camera",
            only_for="bonn/",
            rpe=(RPESpec(delta=1, unit="s"), RPESpec(delta=1, unit="f")),
        ),
        # as WildGS-SLAM and DROID-W score their last trajectory: images with the nearest true pose,
        # aligned with scale
        Protocol(
            id="droid-w/v1", max_dt=0.08, one_to_one=False, alignment="sim3", trajectory="final"
        ),
        Protocol(
            id="droid-w/v1-bonn",
            max_dt=0.08,
            one_to_one=False,
            alignment="sim3",
            trajectory="final",
            truth="bonn-droid-w",
            only_for="bonn/",
        ),
        # MonST3R's: every third matched frame, the first 90 of them
        Protocol(
            id="tum-dynamics-90/v1",
            alignment="sim3",
            every=3,
            most_frames=90,
            trajectory="final",
            rpe=(RPESpec(delta=1, unit="f", pairs="all"),),
        ),
    )
}


@lru_cache(maxsize=64)
def _digest(protocol: Protocol) -> str:
    """Taken once: lists of a hundred thousand runs ask for it as often."""
    # what came after the first protocols counts where it is used only
    fields = protocol.model_dump(mode="json")
    defaults = {
        name: Protocol.model_fields[name].default
        for name in ("truth", "every", "most_frames", "only_for")
    }
    used = {
        name: value
        for name, value in fields.items()
        if name not in defaults or value != defaults[name]
    }
    rpe = [
        spec.model_dump(mode="json", exclude=set() if spec.rate else {"rate"})
        for spec in protocol.rpe
    ]
    # a field once: stored metrics keep their digest
    used["rpe"] = [spec | {"tolerance": 0.1} for spec in rpe]
    return digest(used)


def get_protocol(name: str | Protocol) -> Protocol:
    """A registered protocol by its id; a `Protocol` is returned as it is.

    Raises:
        EvaluationError: Unknown id, with a did-you-mean.
    """
    if isinstance(name, Protocol):
        return name
    if name not in PROTOCOLS:
        raise EvaluationError(f"unknown protocol '{name}'", did_you_mean(name, PROTOCOLS))
    return PROTOCOLS[name]
