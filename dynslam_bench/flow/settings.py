"""What can be set about the optical flow."""

from __future__ import annotations

from typing import Literal

from dynslam_bench.core.settings import Scalar, Settings, names, tunable

_DAISY = {"method": ["daisy"]}
_EMFOA = {
    "method": ["daisy"],
    "search": ["emfoa+propagation", "emfoa-literal+propagation", "emfoa", "emfoa-literal"],
}
_PROPAGATING = {
    "method": ["daisy"],
    "search": [
        "emfoa+propagation",
        "emfoa-literal+propagation",
        "patchmatch",
        "random+propagation",
        "none+propagation",
    ],
}
_LUCAS_KANADE = {"method": ["lucas-kanade"]}
_REFINED = {"method": ["daisy"], "refinement": ["lucas-kanade"]}
_MOTHS = {"method": ["daisy"], "search": [*_EMFOA["search"], "mfo"]}
_SPARSE = {"method": ["daisy"], "mode": ["sparse"]}
_DENSE = {"method": ["daisy"], "mode": ["dense"]}
_THREE_TERMS: dict[str, list[Scalar]] = {"method": ["daisy"], "terms": [3]}

SearchName = Literal[
    "emfoa+propagation", "emfoa-literal+propagation", "patchmatch", "random+propagation", "none+propagation",
    "emfoa", "mfo", "emfoa-literal", "random",
]  # fmt: skip


class FlowSettings(Settings):
    """Optical flow of sparse points and of whole images.

    The defaults are those with which `docs/flow.md` was measured.
    """

    method: Literal["daisy", "lucas-kanade", "dis"] = tunable(
        "daisy", meaning="DAISY Filter Flow with a label search, pyramidal Lucas-Kanade, or dense inverse search"
    )
    plugin: str = names(
        "", "flow", meaning="id, module:Attr or file.py:Attr of a flow plug-in that takes the place of `method`"
    )
    mode: Literal["sparse", "dense"] = tunable(
        "sparse",
        when=_DAISY,
        meaning="labels searched at the points alone, or at superpixels, the guided filter's costs over every "
        "pixel and winner takes all (Eq. 2-3), read at the points",
    )
    search: SearchName = tunable(
        "emfoa+propagation",
        when=_DAISY,
        meaning="label search: enhanced moth-flame, its equations as printed, PatchMatch, random or none (only labels "
        "known beforehand), with neighbours exchanging labels; or moth-flame and random without that",
    )
    budget: int = tunable(
        64, low=24, high=384, limits=(8, 4096), scale="log", online=True, when=_SPARSE,
        meaning="cost evaluations a point in the label search (sparse mode)",
    )  # fmt: skip
    population: int = tunable(6, low=4, high=16, limits=(2, 32), when=_MOTHS, meaning="moths (and flames) a point")
    sweeps: int = tunable(
        4,
        low=1,
        high=8,
        limits=(1, 32),
        when={**_PROPAGATING, "mode": ["sparse"]},
        meaning="times neighbours exchange their best labels",
    )
    neighbours: int = tunable(
        4, low=1, high=8, limits=(0, 8), when=_PROPAGATING, meaning="neighbours whose labels are tried in each sweep"
    )
    similarity_seeds: bool = tunable(
        True, when=_PROPAGATING, meaning="between sweeps, try the two similarity motions that most points agree with"
    )
    range_px: float = tunable(
        96.0, low=16.0, high=192.0, limits=(1.0, 1024.0), scale="log", unit="px", online=True, when=_SPARSE,
        meaning="largest displacement searched, around the guess where there is one",
    )  # fmt: skip
    scale_range_octaves: float = tunable(
        1.0, low=0.0, high=1.25, unit="octaves", when=_DAISY, meaning="largest change of scale searched, both ways"
    )
    rotation_range_deg: float = tunable(
        45.0, low=0.0, high=45.0, unit="deg", when=_DAISY, meaning="largest rotation searched, both ways"
    )
    cauchy_step_px: float = tunable(
        2.0, low=0.25, high=16.0, scale="log", unit="px", when=_EMFOA, meaning="scale of the Cauchy steps of Eq. 13"
    )
    support: Literal[1, 5, 9] = tunable(
        1, when=_SPARSE, meaning="points around each point over which Eq. 1 is summed (Eq. 6; dense mode: 9)"
    )
    support_spacing_px: int = tunable(
        4,
        low=1,
        high=16,
        unit="px",
        when={"method": ["daisy"], "mode": ["sparse"], "support": [5, 9]},
        meaning="distance of those points",
    )
    terms: Literal[1, 3] = tunable(
        1,
        when=_DAISY,
        meaning="terms of Eq. 1: the descriptors' alone, as in the original DAISY Filter Flow, or grey level and "
        "gradient as well",
    )
    truncation: float = tunable(
        0.882,
        low=0.25,
        high=2.0,
        limits=(0.01, 4.0),
        when=_DAISY,
        meaning="t of Eq. 1: largest L1 distance of one histogram of unit norm",
    )
    intensity_weight: float = tunable(
        55.0, low=5.0, high=110.0, limits=(0.0, None), when=_THREE_TERMS, meaning="alpha of Eq. 1, for images in [0, 1]"
    )
    intensity_limit: float = tunable(
        7 / 255, low=0.005, high=0.1, limits=(0.0, 1.0), when=_THREE_TERMS, meaning="t1 of Eq. 1, grey levels in [0, 1]"
    )
    gradient_weight: float = tunable(
        190.0,
        low=20.0,
        high=380.0,
        limits=(0.0, None),
        when=_THREE_TERMS,
        meaning="beta of Eq. 1, for images in [0, 1]",
    )
    gradient_limit: float = tunable(
        2 / 255, low=0.002, high=0.05, limits=(0.0, 1.0), when=_THREE_TERMS, meaning="t2 of Eq. 1, grey levels a pixel"
    )
    refinement: Literal["none", "parabola", "lucas-kanade"] = tunable(
        "lucas-kanade",
        when=_DAISY,
        meaning="sub-pixel step: none, a parabola through the costs, or a similarity Lucas-Kanade (sparse: after "
        "the parabola)",
    )
    refinement_window_px: int = tunable(
        17, low=9, high=31, limits=(5, 41), unit="px", when=_REFINED, meaning="side of the refinement's window, odd"
    )
    refinement_iterations: int = tunable(
        3, low=1, high=10, limits=(1, 50), when=_REFINED, meaning="most translation steps a warp of the refinement"
    )
    window_px: int = tunable(
        21, low=9, high=41, limits=(3, 101), unit="px", when=_LUCAS_KANADE, meaning="side of Lucas-Kanade's window, odd"
    )
    levels: int = tunable(
        4, low=1, high=6, limits=(1, 8), when=_LUCAS_KANADE, meaning="pyramid levels, the full image included"
    )
    dis_preset: Literal["ultrafast", "fast", "medium"] = tunable(
        "medium", when={"method": ["dis"]}, meaning="effort of the dense inverse search"
    )
    forward_backward_px: float = tunable(
        1.5, low=0.25, high=8.0, limits=(0.0, 100.0), scale="log", unit="px", online=True,
        meaning="largest distance between a point and its way there and back; 0 switches the check off (in dense mode "
        "`dense_forward_backward_px` stays)",
    )  # fmt: skip
    max_cost: float = tunable(
        0.75, low=0.3, high=1.0, limits=(0.0, 1.0), online=True, when=_DAISY,
        meaning="matching cost, as a share of its largest value, above which a point is not found",
    )  # fmt: skip
    min_correlation: float = tunable(
        0.85, low=0.5, high=0.97, limits=(-1.0, 1.0), online=True, when={**_REFINED, "mode": ["sparse"]},
        meaning="zero-mean normalised correlation of the refined windows below which a point is not found",
    )  # fmt: skip
    dense_superpixel_px: int = tunable(
        12, low=8, high=32, limits=(4, 128), unit="px", when=_DENSE, meaning="dense mode: side of a superpixel"
    )
    dense_candidates: int = tunable(
        5,
        low=2,
        high=9,
        limits=(1, 9),
        when=_DENSE,
        meaning="dense mode: labels tried at each pixel, its superpixel's own and its neighbours'",
    )
    dense_filter_radius_px: int = tunable(
        5, low=2, high=16, limits=(2, 32), unit="px", when=_DENSE, meaning="dense mode: guided filter's radius (Eq. 2)"
    )
    dense_filter_epsilon: float = tunable(
        0.01, low=1e-4, high=0.1, limits=(1e-9, 10.0), scale="log", when=_DENSE,
        meaning="dense mode: guided filter's regularisation, images in [0, 1] (Eq. 2)",
    )  # fmt: skip
    dense_forward_backward_px: float = tunable(
        3.0, low=0.5, high=15.0, limits=(0.0, 100.0), scale="log", unit="px", when=_DENSE,
        meaning="dense mode: largest distance between a pixel and its way there and back",
    )  # fmt: skip
    dense_second_round: bool = tunable(
        True, when=_DENSE, meaning="dense mode: try on every region the motion that consistent regions nearby suggest"
    )
    dense_budget: int = tunable(
        384, low=48, high=768, limits=(8, 4096), scale="log", when=_DENSE,
        meaning="dense mode: cost evaluations a superpixel in the label search",
    )  # fmt: skip
    dense_sweeps: int = tunable(
        12, low=1, high=16, limits=(1, 32), when={**_PROPAGATING, "mode": ["dense"]}, meaning="dense mode: `sweeps`"
    )
    dense_range_px: float = tunable(
        160.0, low=16.0, high=256.0, limits=(1.0, 1024.0), scale="log", unit="px", when=_DENSE,
        meaning="dense mode: `range_px`",
    )  # fmt: skip

    @property
    def idle(self) -> str:
        """What a plug-in does with these settings is not known, so that none of them is offered for steering."""
        return f"flow.plugin is {self.plugin!r}" if self.plugin else ""
