"""What the columns of a table are called: as short as tells them apart, parts always marked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dynslam_bench.core.toml import label_text, setting_text
from dynslam_bench.reports.model.row import SEEN, RunRow


def name_columns(rows: Sequence[RunRow]) -> dict[str, str]:
    """A name for every column, no two alike.

    Recordings that share a name are told apart by the last parts of their folders' paths, then by camera, content and
    frames: ``chess/seq-01`` and ``fire/seq-01``.

    Returns:
        Column id (see `RunRow.column_id`) to its name.
    """
    first: dict[str, RunRow] = {}
    for row in sorted(rows, key=lambda row: (row.noise is not None, row.offset, len(_name(row)), _name(row))):
        first.setdefault(row.column_id, row)
    alike: dict[str, dict[str, RunRow]] = {}
    for column, row in first.items():
        alike.setdefault(_name(row), {})[column] = row
    names: dict[str, str] = {}
    for name, group in alike.items():
        names |= {column: name for column in group} if len(group) == 1 else _told_apart(name, group)
    return names


def shortened(names: Sequence[str]) -> dict[str, str]:
    """Names without the folders, and without the options (``scene=...``, ``frames=...``), that all of them share.

    The part of a sequence, `` [0:60]``, always stays.
    """
    if len(names) < 2:
        return {name: name for name in names}
    folders = [_split(name)[0].split("/")[:-1] for name in names]
    shared = 0
    while all(len(parts) > shared and parts[shared] == folders[0][shared] for parts in folders):
        shared += 1
    common = set[str].intersection(*(set(_split(name)[1]) for name in names))
    short = {}
    for name in names:
        stem, options, part = _split(name)
        kept = "&".join(option for option in options if option not in common)
        short[name] = "/".join(stem.split("/")[shared:]) + (f"?{kept}" if kept else "") + part
    return short if len(set(short.values())) == len(names) else {name: name for name in names}


def _split(name: str) -> tuple[str, list[str], str]:
    """Stem, the options behind the ``?``, and `` [part] (words)`` of a name."""
    whole = min((name.partition(mark)[0] for mark in (" [", " (")), key=len)
    stem, _, query = whole.partition("?")
    return stem, query.split("&") if query else [], name[len(whole) :]


def _name(row: RunRow) -> str:
    """Sequence without its noise, and part of it."""
    base, _, query = row.sequence.partition("?")
    kept = "&".join(word for word in query.split("&") if word and not word.startswith("noise="))
    return base + (f"?{kept}" if kept else "") + (f" [{row.frames}]" if row.frames else "")


def _told_apart(name: str, group: Mapping[str, RunRow]) -> dict[str, str]:
    names = dict.fromkeys(group, name)
    places = {column: Path(row.place).parts for column, row in group.items()}
    if all(places.values()):
        for length in range(1, max(map(len, places.values())) + 1):
            tails = {column: "/".join(parts[-length:]) for column, parts in places.items()}
            if len(set(tails.values())) == len(set(places.values())):
                part = _split(name)[2]
                names = {column: tail + part for column, tail in tails.items()}
                break
    marks: tuple[Callable[[str, RunRow], str], ...] = (
        lambda _, row: row.camera,
        lambda _, row: f"content {row.content[:6]}" if row.content else "",
        lambda column, _: f"frames {column[:6]}",
        lambda column, _: column,
    )
    for mark in marks:
        words = {column: mark(column, row) for column, row in group.items()}
        if len(set(names.values())) < len(names) and len(set(words.values())) > 1:
            names = {column: f"{each} ({words[column]})" if words[column] else each for column, each in names.items()}
    return names


# What the rows of a table are called.

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
