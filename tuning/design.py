"""Which blocks of a study are for what: to race on, to choose on, to be judged on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from dynslam_bench.core.folders import find_data_root
from dynslam_bench.sequences.catalogue import catalogue, open_public

from .blocks import Block, scenes
from .race import running_order
from .splits import Split, check_splits
from .statistics import place_of
from .study_file import StudySpec

FEWEST_STARTS = 3
"""The default settings run from so many starts at every place: the luck of one would be shared by all trials."""
ENOUGH_SCENES = 12
"""With so many tune scenes a third of them is kept for the choice; else other starts in all of them are."""
FRESH_SEED = 1000
"""Seeds of fresh starts: none that a trial has used."""
RECORDED_FRAMES, RECORDED_STARTS = 120, 4


@dataclass(frozen=True)
class Design:
    """The blocks of a study.

    Attributes:
        race: What trials run on, in the order in which all meet them.
        reference: What the default settings run on beforehand: `race`, and more starts where those are few.
        confirm: What the best trials and the default run on for the choice; no trial has seen them.
        held_out: What judges the choice.
        recorded: Recordings on which the choice must not be worse.
        notes: How the splits are not apart, where the study accepts that; to be shown beside every number.
    """

    race: tuple[Block, ...]
    reference: tuple[Block, ...]
    confirm: tuple[Block, ...]
    held_out: tuple[Block, ...]
    recorded: tuple[Block, ...]
    notes: tuple[str, ...] = ()


def design_of(spec: StudySpec, *, accept: bool = False) -> Design:
    """Lay out the blocks of a study and check them.

    Args:
        spec: The study.
        accept: Whether splits that are not apart are only noted, as for a study that is only looked at.

    Raises:
        DynslamError: See `splits.check_splits`.
    """
    race, confirm = _race_and_confirm(spec.blocks(*spec.tune), spec.blocks(*spec.confirm))
    held_out = spec.blocks(*spec.held_out)
    notes = check_splits(
        spec.name,
        {"tune": race, "confirm": confirm, "held_out": held_out},
        data_root=spec.data_root,
        accept=accept or spec.allow_overlap,
    )
    taken = {block.scene for block in (*race, *confirm, *held_out)}
    recorded = _recordings(spec, taken) if spec.recorded is None else spec.blocks(*spec.recorded)
    if spec.recorded:
        apart: dict[Split, list[Block]] = {"tune": [*race, *confirm], "held_out": recorded}
        notes += check_splits(spec.name, apart, data_root=spec.data_root, accept=accept or spec.allow_overlap)
    race = running_order(race, spec.sampler_seed)
    return Design(
        tuple(race), tuple(with_more_starts(race)), tuple(confirm), tuple(held_out), tuple(recorded), tuple(notes)
    )


def with_more_starts(blocks: Sequence[Block]) -> list[Block]:
    """The blocks, and more starts of each place that has fewer than `FEWEST_STARTS`."""
    found = list(blocks)
    for place in dict.fromkeys(place_of(block) for block in blocks):
        own = [block for block in blocks if place_of(block) == place]
        missing = FEWEST_STARTS - len({block.offset for block in own})
        found += [replace(own[0], offset=offset) for offset in _unused(own, missing)]
    return found


def fresh_starts(blocks: Sequence[Block]) -> list[Block]:
    """As many blocks at each place from starts, and with seeds, that none of the blocks has."""
    found = []
    for place in dict.fromkeys(place_of(block) for block in blocks):
        own = [block for block in blocks if place_of(block) == place]
        offsets = _unused(own, len(own))
        found += [replace(place, offset=offset, seed=FRESH_SEED + index) for index, offset in enumerate(offsets)]
    return found


def _unused(blocks: Sequence[Block], count: int) -> list[int]:
    used = {block.offset for block in blocks}
    return [offset for offset in range(len(used) + max(count, 0)) if offset not in used][: max(count, 0)]


def _race_and_confirm(tune: list[Block], confirm: list[Block]) -> tuple[list[Block], list[Block]]:
    if confirm:
        return tune, confirm
    groups = list(scenes(tune).values())
    if len(groups) < ENOUGH_SCENES:
        return tune, fresh_starts(tune)
    kept = groups[2::3]
    return [block for group in groups if group not in kept for block in group], [b for group in kept for b in group]


def _recordings(spec: StudySpec, taken: set[str]) -> list[Block]:
    """The first frames of the first held-out recording that is here and that the study does not name itself."""
    root = find_data_root(spec.data_root)
    for entry in catalogue().values():
        if entry.split == "held-out" and entry.id not in taken and entry.find(root) is not None:
            frames = min(RECORDED_FRAMES + RECORDED_STARTS - 1, len(open_public(entry.id, data_root=root)))
            return [Block(entry.id, (0, frames), offset) for offset in range(RECORDED_STARTS)]
    return []
