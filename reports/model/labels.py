"""What the rows of a table are called."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from dynslam_bench.core.toml import label_text, setting_text

from .row import SEEN, RunRow

ALWAYS = ("map", "backend.map.localisation_only")
"""Named in any table: a run that begins in a map knows more than one that begins without."""
OF_ALL = {"device", "threads"}
"""What every run has a value of, asked for or not."""


def make_labels(rows: Sequence[RunRow]) -> dict[str, str]:
    """A name for every variant: the tracker's label and what sets it apart from the tracker's other variants.

    What one tracker alone was asked for is named though it has no other variant; what several were, as all that a suite
    runs, is not.
    Behind it stands `SEEN` if any of its runs had masks of a network that was trained on the scene.
    """
    seen = {row.variant_key for row in rows if row.seen_in_training}
    variants: dict[str, RunRow] = {}
    for row in rows:
        variants.setdefault(row.variant_key, row)
    by_tracker: dict[str, list[RunRow]] = {}
    by_label: dict[str, set[str]] = {}
    for row in variants.values():
        by_tracker.setdefault(row.tracker, []).append(row)
        by_label.setdefault(row.label, set()).add(row.tracker)
    differing_of = {tracker: _differing(others) for tracker, others in by_tracker.items()}
    single = {tracker: _single(tracker, by_tracker) for tracker in by_tracker}
    kinds = {tracker: {other.kind for other in others} for tracker, others in by_tracker.items()}
    labels = {}
    values = [value for row in variants.values() for value in row.variant.values()]
    texts = _short_texts(values)
    for key, row in variants.items():
        shown = {*differing_of[row.tracker], *ALWAYS, *single[row.tracker]}
        parts = [f"{name}={texts[setting_text(value)]}" for name, value in sorted(row.variant.items()) if name in shown]
        parts += [f"{name} {value}" for name, value in sorted(row.split_by.items())]
        if row.imported and len(kinds[row.tracker]) > 1:
            parts.append("imported")
        base = f"{row.label} <{row.tracker}>" if len(by_label[row.label]) > 1 else row.label
        labels[key] = base + (f" · {', '.join(parts)}" if parts else "") + f" {SEEN}" * (key in seen)
    return labels


def _short_texts(values: Iterable[Any]) -> dict[str, str]:
    """Values as texts, each with its short form; whole where two values have the same short form."""
    short = {text: label_text(text) for text in map(setting_text, values)}
    counts = Counter(short.values())
    return {text: each if counts[each] == 1 else text for text, each in short.items()}


def _single(tracker: str, by_tracker: Mapping[str, Sequence[RunRow]]) -> list[str]:
    """What only this tracker was asked for."""
    asked = {each: {name for row in rows for name in row.variant} - OF_ALL for each, rows in by_tracker.items()}
    return sorted(asked[tracker].difference(*(names for each, names in asked.items() if each != tracker)))


def _differing(variants: Sequence[RunRow]) -> list[str]:
    """The settings that set the variants of one tracker apart."""
    names = sorted({name for row in variants for name in row.variant})
    return [name for name in names if len({str(row.variant.get(name)) for row in variants}) > 1]
