"""The contract of all sparse flows: where do these points of one image lie in another?"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class FlowResult:
    """Correspondences of N points.

    Attributes:
        xy: float32 ``[N, 2]``, where each point lies in the target image, pixels; undefined where
            not valid.
        valid: bool ``[N]``, found and consistent (forward-backward check where the method has one).
        cost: float32 ``[N]``, the method's matching cost (lower is better), comparable within one
            result only.
        stats: Diagnostics, e.g. ``{"evaluations": 120000.0, "valid": 931.0}``.
    """

    xy: NDArray[np.float32]
    valid: NDArray[np.bool_]
    cost: NDArray[np.float32]
    stats: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class FlowSpec:
    """Announces an optical flow; importable without torch or OpenCV.

    Attributes:
        id: Name that `FlowSettings.method` (built in) or `FlowSettings.plugin` takes.
        entry_point: ``"module:factory"``; called as
            ``factory(settings: FlowSettings, *, device: str, threads: int)``, returns a
            `FlowEstimator`.
        summary: One line.
        license: SPDX id or remark.
    """

    id: str
    entry_point: str
    summary: str = ""
    license: str = ""


@runtime_checkable
class FlowEstimator(Protocol):
    """Sparse optical flow between two images.

    `prepare` does what depends on one image only (pyramids, descriptor maps), so that a frame that
    is first target and then reference is prepared once.

    Optional attribute, found by name: ``stats_names``, the names of the stats that every result
    holds (see `stats_names_of`).
    """

    def prepare(self, gray: NDArray[np.uint8]) -> Any:
        """Whatever the method needs of a uint8 ``[H, W]`` image."""

    def track(
        self,
        reference: Any,
        target: Any,
        points: NDArray[np.float32],
        *,
        guess: NDArray[np.float32] | None = None,
        seed: int = 0,
    ) -> FlowResult:
        """Find the points of the reference image in the target image.

        Args:
            reference: `prepare`d image that holds the points.
            target: `prepare`d image in which they are looked for.
            points: float32 ``[N, 2]`` pixels; N = 0 gives an empty result.
            guess: float32 ``[N, 2]`` predicted positions in the target; rows that are not finite
                mean "no guess".
            seed: Everything random is a function of this number (and of the point's index).

        Returns:
            One row a point; degenerate input (black, identical, textureless images) gives rows that
            are not valid, never an exception or NaN in valid rows.
        """


def stats_names_of(flow: FlowEstimator) -> tuple[str, ...]:
    """The stats that a flow declares, in order; none if it declares nothing.

    A pipeline shows these and no others: on frames without a previous one they are zero.
    """
    return tuple(getattr(flow, "stats_names", ()))
