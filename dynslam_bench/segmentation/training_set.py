"""Which sequences a network of this package was trained on: what it scores there is its best case, no judgement."""

from __future__ import annotations

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.sequences.synthetic import TUNE_INSTANCES, parse_synthetic_id


def seen_in_training(source: str, sequence_id: str) -> bool:
    """Whether masks come from a network that was trained on frames of that very scene.

    Known of the embedded network alone: it was trained on every rendered sequence of the instances 0-99.

    Args:
        source: Where the masks come from, resolved (``embedded``, never ``auto``).
        sequence_id: For example ``synthetic/walking_xyz?scene=3``.
    """
    if source != "embedded" or not sequence_id.startswith("synthetic/"):
        return False
    try:
        return parse_synthetic_id(sequence_id).scene in TUNE_INSTANCES
    except SequenceError:  # an imported trajectory may name any sequence
        return False
