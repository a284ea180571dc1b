"""Scenes that the embedded network was trained on. The list lies apart from the networks, which need no renderer."""

from dynslam_bench.core import SequenceError
from dynslam_bench.sequences.synthetic import TUNE_SCENES, parse_synthetic_id


def seen_in_training(source: str, sequence_id: str) -> bool:
    """Whether masks come from a network that was trained on frames of that scene.

    This is known of the embedded network only: it was trained on every rendered sequence of the
    scenes 0-99.

    Args:
        source: Source of the masks, resolved (``embedded``, never ``auto``).
        sequence_id: For example ``synthetic/walking_xyz?scene=3``.
    """
    if source != "embedded" or not sequence_id.startswith("synthetic/"):
        return False
    try:
        return parse_synthetic_id(sequence_id).scene in TUNE_SCENES
    # an imported trajectory may name any sequence
    except SequenceError:
        return False
