"""Settings of a dense flow that finds little, but soon: for tests that ask what a system does with it."""

from __future__ import annotations

from dynslam_bench.core.settings import Settings

QUICK_DENSE = {
    "flow.dense_budget": 16,
    "flow.dense_sweeps": 1,
    "flow.dense_candidates": 2,
    "flow.dense_second_round": False,
    "flow.dense_superpixel_px": 24,
    "flow.dense_filter_radius_px": 2,
}


def quick(settings: type[Settings]) -> dict[str, object]:
    """Overrides with which a system's flow costs little; none where it has no dense flow."""
    dense = "flow" in settings.model_fields and settings().flow.mode == "dense"
    return dict(QUICK_DENSE) if dense else {}
