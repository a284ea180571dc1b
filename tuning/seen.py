"""Which blocks of a study show scenes that the network behind the masks was trained on: a best case there."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from dynslam_bench.core.settings import Settings
from dynslam_bench.reports.model.row import SEEN
from dynslam_bench.segmentation.training_set import seen_in_training

from .blocks import Block
from .design import Design


def source_of_masks(settings: Settings, sequences: Sequence[str]) -> str:
    """Where a system's masks come from; the embedded network for ``auto`` where everything is rendered.

    Args:
        settings: Of the system.
        sequences: What it runs on.

    Returns:
        For example ``embedded``; empty for a system without masks.
    """
    source = str(getattr(getattr(settings, "segmentation", None), "source", ""))
    rendered = bool(sequences) and all(name.startswith("synthetic/") for name in sequences)
    return "embedded" if source == "auto" and rendered else source


def splits_seen(settings: Settings, design: Design) -> list[str]:
    """Names of a study's splits with a scene that the network behind the masks was trained on, in their order."""
    splits = {"tune": design.race, "confirm": design.confirm, "held_out": design.held_out}
    return [name for name, blocks in splits.items() if any(_seen(settings, blocks))]


def seen_note(splits: Sequence[str]) -> str:
    """What such splits mean for a study, in one sentence; empty without any."""
    if not splits:
        return ""
    named = " and ".join({"tune": "race", "confirm": "choice", "held_out": "held-out blocks"}[name] for name in splits)
    judged = (
        "so nothing here judges the masks: held-out blocks are rendered scenes from 100 on"
        if "held_out" in splits
        else "so the errors there flatter it, and the held-out blocks, which it has not seen, may gain less"
    )
    return f"{SEEN} In the {named} the masks come from a network that was trained on those very scenes, {judged}."


def _seen(settings: Settings, blocks: Iterable[Block]) -> Iterable[bool]:
    return (seen_in_training(source_of_masks(settings, [each.sequence]), each.sequence) for each in blocks)
