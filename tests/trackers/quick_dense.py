"""Settings of a dense flow that finds little, but soon: for tests that ask what a system does with it."""

from dynslam_bench.core.settings import Settings
from dynslam_bench.flow.settings import DenseFlowSettings

QUICK_DENSE = {
    "flow.budget": 16,
    "flow.sweeps": 1,
    "flow.candidates": 2,
    "flow.second_round": False,
    "flow.superpixel_px": 24,
    "flow.filter_radius_px": 2,
}


def quick(settings: type[Settings]) -> dict[str, object]:
    """Overrides with which a system's flow costs little; none where it has no dense flow."""
    dense = "flow" in settings.model_fields and isinstance(settings().flow, DenseFlowSettings)
    return dict(QUICK_DENSE) if dense else {}
