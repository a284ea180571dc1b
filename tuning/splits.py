"""Whether a study's tune and held-out splits are what they say: by content, by the catalogue, by the instances."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, product
from pathlib import Path
from typing import Any

from dynslam_bench.core.errors import StudyError
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.sequences.part import Part, part_of
from dynslam_bench.sequences.synthetic import HELD_OUT_INSTANCES, TUNE_INSTANCES

from .same_recording import is_rendered, same_recording
from .study_file import StudySpec

OVERRIDE = "allow_overlap = true in the study file accepts it, and every table of the study will say so"


def check_splits(spec: StudySpec, *, refuse: bool = True) -> list[str]:
    """Compare the splits of a study.

    Two sequences overlap if they film the same content, however they are called: other frames or another draw of the
    noise of a sequence are no other sequence, nor is a copy or an excerpt of a recording in another folder, with other
    file names, other stamps or other image files (`same_recording`). A sequence that the catalogue, or its instance,
    gives to one split must not stand in the other.

    Args:
        spec: The study.
        refuse: Whether to raise what the study does not accept; False to look at a study that was run before.

    Returns:
        What is wrong, a line each, if the study accepts it (`StudySpec.allow_overlap`) or nothing is refused.

    Raises:
        StudyError: Something is wrong and not accepted, or one split names the same frames twice; names both spellings.
        SequenceError: A sequence is unknown or missing.
    """
    opened = {name: _open(name, spec) for name in (*spec.tune, *spec.held_out)}
    parts = {name: part_of(sequence) for name, sequence in opened.items()}
    for split, names in (("tune", spec.tune), ("held_out", spec.held_out)):
        for one, other in combinations(names, 2):
            if replace(parts[one], id="") == replace(parts[other], id=""):
                raise StudyError(f"{split} names the same frames twice, as '{one}' and as '{other}'", "leave one out")
    faults = [
        f"'{one}' to tune on and '{other}' held out are the same sequence"
        for one, other in product(spec.tune, spec.held_out)
        if _overlap(opened[one], parts[one], opened[other], parts[other])
    ]
    faults += [_misplaced(name, "tune", "held-out") for name in spec.tune if _split(opened[name]) == "held-out"]
    faults += [_misplaced(name, "held-out", "tune") for name in spec.held_out if _split(opened[name]) == "tune"]
    if faults and refuse and not spec.allow_overlap:
        more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
        raise StudyError(f"the splits of study '{spec.name}' are not apart: {faults[0]}{more}", OVERRIDE)
    return faults


def _open(name: str, spec: StudySpec) -> Any:
    return open_sequence(name, data_root=None if spec.data_root is None else Path(spec.data_root))


def _split(sequence: Any) -> str:
    return str(getattr(sequence, "split", ""))


def _misplaced(name: str, used: str, own: str) -> str:
    who = "the catalogue"
    if name.startswith("synthetic/"):
        own_range = HELD_OUT_INSTANCES if own == "held-out" else TUNE_INSTANCES
        who = f"its instance ({own_range.start}-{own_range.stop - 1})"
    return f"'{name}' is used as {used}, but {who} puts it into the {own} split"


def _overlap(one: Any, part: Part, other: Any, other_part: Part) -> bool:
    """Whether two sequences film the same: the same content by digest, or the same images on the same way."""
    if part.scene == other_part.scene:
        return True
    if is_rendered(one) and is_rendered(other):
        return False  # rendered scenes are told apart by their parameters
    return same_recording(one, other)
