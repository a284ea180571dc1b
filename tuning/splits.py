"""Whether a study's blocks are what they say: apart by content, by the catalogue, by the scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations, product
from typing import Any, Literal, cast

from dynslam_bench.core.errors import StudyError
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.sequences.part import Part, part_of
from dynslam_bench.sequences.synthetic import HELD_OUT_INSTANCES, TUNE_INSTANCES

from .blocks import Block
from .same_recording import is_rendered, same_recording

OVERRIDE = "allow_overlap = true in the study file accepts it, and every table of the study will say so"

Split = Literal["tune", "confirm", "held_out"]


def check_splits(
    name: str, splits: Mapping[Split, Sequence[Block]], *, data_root: str | None = None, accept: bool = False
) -> list[str]:
    """Open every block of a study and compare its splits.

    Two splits overlap if they film the same content, however it is called: other frames or another draw of the noise of
    a sequence are no other sequence, nor is a copy or an excerpt of a recording in another folder, with other file
    names, other stamps or other image files (`same_recording`). `tune` and `confirm` may share a scene, but no frames
    from the same start. A sequence that the catalogue, or its scene, gives to one split must not stand in the other.

    Args:
        name: Of the study.
        splits: Its blocks: to tune on, to judge the survivors on, and held out.
        data_root: Folder of the recorded sequences.
        accept: Whether the study accepts it (`StudySpec.allow_overlap`).

    Returns:
        What is wrong, a line each, where it is accepted.

    Raises:
        StudyError: Something is wrong and not accepted, a split names the same frames twice, or a block is longer than
            its sequence, too short or without ground truth; names both spellings.
        SequenceError: A sequence is unknown or missing.
    """
    tune, held_out = [*splits.get("tune", ()), *splits.get("confirm", ())], list(splits.get("held_out", ()))
    tuned = dict.fromkeys(block.sequence for block in tune)
    judged = dict.fromkeys(block.sequence for block in held_out)
    whole: dict[str, Any] = {each: open_sequence(each, data_root=data_root) for each in (*tuned, *judged)}
    for own in (tune, held_out):
        _check_repeats(own, whole)
    parts = {name: part_of(found) for name, found in whole.items()}
    faults = [
        f"'{one}' to tune on and '{other}' held out are the same sequence"
        for one, other in product(tuned, judged)
        if _overlap(whole[one], parts[one], whole[other], parts[other])
    ]
    faults += [_misplaced(each, "tune", "held-out") for each in tuned if _split(whole[each]) == "held-out"]
    faults += [_misplaced(each, "held-out", "tune") for each in judged if _split(whole[each]) == "tune"]
    if faults and not accept:
        more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
        raise StudyError(f"the splits of study '{name}' are not apart: {faults[0]}{more}", OVERRIDE)
    return faults


def _check_repeats(blocks: Sequence[Block], whole: Mapping[str, Any]) -> None:
    """Within a split, blocks of one scene are repeats of the same frames or share no frame."""
    if len(set(blocks)) < len(blocks):
        twice = next(block for block in blocks if list(blocks).count(block) > 1)
        raise StudyError(f"block '{twice}' is named twice", "leave one out")
    by_scene: dict[str, list[tuple[Block, Part]]] = {}
    for block in blocks:
        part = part_of(cast("Any", block.cut(whole[block.sequence])), block.offset)
        by_scene.setdefault(part.scene, []).append((block, part))
    for same in by_scene.values():
        for (one, here), (other, there) in combinations(same, 2):
            if _seen(one, here) == _seen(other, there):
                raise StudyError(f"'{one}' and '{other}' are the same frames", "leave one out")
            if (here.start, here.stop) != (there.start, there.stop) and _common(here, there) > 0:
                raise StudyError(
                    f"'{one}' and '{other}' share {_common(here, there)} frames", "write blocks of a sequence apart"
                )


def _seen(block: Block, part: Part) -> tuple[object, ...]:
    own = (block.offset, block.degradation, block.seed, part.noise, part.start, part.stop, part.stride)
    return (part.content, *own)


def _common(one: Part, other: Part) -> int:
    return min(one.stop, other.stop) - max(one.start, other.start)


def _split(sequence: Any) -> str:
    return str(getattr(sequence, "split", ""))


def _misplaced(name: str, used: str, own: str) -> str:
    who = "the catalogue"
    if name.startswith("synthetic/"):
        own_range = HELD_OUT_INSTANCES if own == "held-out" else TUNE_INSTANCES
        who = f"its scene ({own_range.start}-{own_range.stop - 1})"
    return f"'{name}' is used as {used}, but {who} puts it into the {own} split"


def _overlap(one: Any, part: Part, other: Any, other_part: Part) -> bool:
    """Whether two sequences film the same: the same content by digest, or the same images on the same way."""
    if part.scene == other_part.scene:
        return True
    if is_rendered(one) and is_rendered(other):
        return False  # rendered scenes are told apart by their parameters
    return same_recording(one, other)
