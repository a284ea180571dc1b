"""Settings of the optical flow; importing this module loads neither OpenCV nor torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from dynslam_bench.core.settings import Settings, names, tunable

SearchName = Literal[
    "emfoa+propagation",
    "emfoa-literal+propagation",
    "mfo+propagation",
    "patchmatch",
    "random+propagation",
    "none+propagation",
    "emfoa",
    "mfo",
    "emfoa-literal",
    "random",
]


class FlowMethodSettings(Settings):
    """Settings of every flow, and the few options of the OpenCV flows; enough for Lucas-Kanade and DIS."""

    method: Literal["daisy", "lucas-kanade", "dis"] = Field(
        "daisy",
        description="DAISY Filter Flow with a label search, pyramidal Lucas-Kanade, or dense inverse search",
    )
    plugin: str = names(
        "",
        "flow",
        meaning="id, module:Attr or file.py:Attr of a flow plug-in that takes the place of `method`",
    )
    window_px: int = Field(
        21, ge=3, le=101, description="Lucas-Kanade: side of the window in pixels, odd"
    )
    dis_preset: Literal["ultrafast", "fast", "medium"] = Field(
        "medium", description="dense inverse search: OpenCV's preset"
    )
    forward_backward_px: float = tunable(
        1.5,
        low=0.25,
        high=8.0,
        limits=(0.0, 100.0),
        scale="log",
        unit="px",
        online=True,
        meaning="largest forward-backward error of a valid point; 0 disables the check",
    )


class DaisySettings(FlowMethodSettings):
    """DAISY Filter Flow with its label search; `docs/results/flow.md` was measured with the defaults."""

    search: SearchName = tunable(
        "emfoa+propagation",
        meaning="label search: enhanced moth-flame, its equations as printed, PatchMatch, random or none, with label "
        "propagation between neighbours; or moth-flame and random without propagation",
    )
    budget: int = tunable(
        64,
        low=24,
        high=384,
        limits=(8, 4096),
        scale="log",
        online=True,
        meaning="cost evaluations a point in the label search",
    )
    population: int = tunable(
        6, low=4, high=16, limits=(2, 32), meaning="moths (and flames) a point or superpixel"
    )
    sweeps: int = tunable(
        4, low=1, high=8, limits=(1, 32), meaning="times neighbours exchange their best labels"
    )
    cauchy_step_px: float = tunable(
        2.0,
        low=0.25,
        high=16.0,
        scale="log",
        unit="px",
        meaning="scale of the Cauchy steps of Eq. 13",
    )
    range_px: float = tunable(
        96.0,
        low=16.0,
        high=192.0,
        limits=(1.0, 1024.0),
        scale="log",
        unit="px",
        online=True,
        meaning="largest displacement searched, around the guess where there is one",
    )
    neighbours: int = Field(
        4, ge=0, le=8, description="neighbours whose labels are tried in each sweep"
    )
    similarity_seeds: bool = Field(
        True,
        description="between sweeps, try the two similarity motions with which most points agree",
    )
    scale_range_octaves: float = Field(
        1.0, ge=0.0, le=1.25, description="largest change of scale searched, both ways"
    )
    rotation_range_deg: float = Field(
        45.0, ge=0.0, le=45.0, description="largest rotation searched, both ways"
    )
    terms: Literal[1, 3] = Field(
        1,
        description="terms of Eq. 1: the descriptors' alone, as in DAISY Filter Flow, or grey level and gradient too",
    )
    refinement: Literal["none", "lucas-kanade"] = Field(
        "lucas-kanade",
        description="sub-pixel step: none, or a parabola through the costs and a similarity Lucas-Kanade",
    )
    refinement_window_px: int = Field(
        17, ge=5, le=41, description="side of the refinement's window, odd"
    )

    @property
    def unused(self) -> Mapping[str, str]:
        """Fields of the label search without effect, and why: another flow runs, or another search uses them."""
        reason = ""
        if self.plugin:
            reason = f"flow.plugin is {self.plugin!r}"
        elif self.method != "daisy":
            reason = f"flow.method is {self.method!r}"
        if reason:
            own = type(self).model_fields.keys() - FlowMethodSettings.model_fields.keys()
            return dict.fromkeys(own, reason)

        # of Eq. 8-17 moths, of Eq. 13 steps; labels pass between neighbours in some searches alone
        kind, _, passing = self.search.partition("+")
        fields = []
        if kind not in ("emfoa", "emfoa-literal", "mfo"):
            fields.append("population")
        if kind not in ("emfoa", "emfoa-literal"):
            fields.append("cauchy_step_px")
        if not passing and kind != "patchmatch":
            fields += ["sweeps", "neighbours"]
        return dict.fromkeys(fields, f"flow.search is {self.search!r}")


class FlowSettings(DaisySettings):
    """DAISY Filter Flow at sparse points."""

    min_correlation: float = tunable(
        0.85,
        low=0.5,
        high=0.97,
        limits=(-1.0, 1.0),
        online=True,
        meaning="zero-mean normalised correlation of the refined windows below which a point is not valid",
    )
    support: Literal[1, 5, 9] = Field(
        1, description="points around each point over which Eq. 1 is summed (Eq. 6)"
    )
    support_spacing_px: int = Field(4, ge=1, le=64, description="distance of those points")


class DenseFlowSettings(DaisySettings):
    """DAISY Filter Flow of every pixel (Eq. 1-3): superpixels, guided filter, winner takes all; read at the points."""

    range_px: float = tunable(
        160.0,
        low=16.0,
        high=256.0,
        limits=(1.0, 1024.0),
        scale="log",
        unit="px",
        meaning="largest displacement searched",
    )
    budget: int = tunable(
        96,
        low=24,
        high=384,
        limits=(8, 4096),
        scale="log",
        online=True,
        meaning="cost evaluations a superpixel in the label search",
    )
    sweeps: int = tunable(
        6, low=1, high=8, limits=(1, 32), meaning="times neighbours exchange their best labels"
    )
    superpixel_px: int = Field(16, ge=4, le=128, description="side of a superpixel")
    candidates: int = Field(
        2,
        ge=1,
        le=9,
        description="labels tried at each pixel: its superpixel's own and its neighbours'",
    )
    filter_radius_px: int = Field(5, ge=2, le=32, description="guided filter's radius (Eq. 2)")
    filter_epsilon: float = Field(
        0.01,
        ge=1e-9,
        le=10.0,
        description="guided filter's regularisation, images in [0, 1] (Eq. 2)",
    )
    consistency_px: float = Field(
        3.0, gt=0.0, le=100.0, description="largest forward-backward error of a consistent pixel"
    )
    second_round: bool = Field(
        True,
        description="try on regions with inconsistent pixels the motion that regions nearby suggest",
    )


class PublishedFlowSettings(FlowMethodSettings):
    """Lucas-Kanade as published systems use it: none of their sources names a forward-backward check."""

    method: Literal["daisy", "lucas-kanade", "dis"] = Field(
        "lucas-kanade", description="which flow; the published one is Lucas-Kanade"
    )
    forward_backward_px: float = Field(
        0.0,
        ge=0.0,
        le=100.0,
        description="largest forward-backward error in pixels; 0, no check, as published",
    )
