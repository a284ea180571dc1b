"""Names of the columns of a table: as short as tells them apart, parts always marked."""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any

from dynslam_bench.core import label_text, setting_text
from dynslam_bench.reports.model.row import SEEN, RunRow, grouped
from dynslam_bench.runs.rows import part_words


def name_columns(rows: Sequence[RunRow]) -> dict[str, str]:
    """A name for every column, no two alike.

    Recordings that share a name are distinguished by the last parts of their folders' paths, then
    by camera, content and frames: ``chess/seq-01`` and ``fire/seq-01``.

    Returns:
        Column id (see `RunRow.sequence_key`) to its name.
    """
    plainest = sorted(
        rows, key=lambda r: (r.sequence.noise is not None, r.offset, len(_name(r)), _name(r))
    )
    columns = [
        of_column[0] for of_column in grouped(plainest, lambda row: row.sequence_key).values()
    ]
    names: dict[str, str] = {}
    for name, group in grouped(columns, _name).items():
        names |= _distinct(name, {row.sequence_key: row for row in group})
    return names


def shortened(names: Sequence[str]) -> dict[str, str]:
    """Names without the folders, and without the options (``scene=...``, ``frames=...``), that all of them share.

    The part of a sequence, `` [0:60]``, always stays.
    """
    if len(names) < 2:
        return {name: name for name in names}
    parts = {name: _split(name) for name in names}
    folders = [stem.split("/")[:-1] for stem, _, _ in parts.values()]
    shared = len(list(takewhile(lambda level: len(set(level)) == 1, zip(*folders, strict=False))))
    common = set[str].intersection(*(set(options) for _, options, _ in parts.values()))
    short = {}
    for name, (stem, options, part) in parts.items():
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
    base, _, query = row.sequence.id.partition("?")
    kept = "&".join(word for word in query.split("&") if word and not word.startswith("noise="))
    part = part_words(row)
    return base + (f"?{kept}" if kept else "") + (f" [{part}]" if part else "")


def _distinct(name: str, group: Mapping[str, RunRow]) -> dict[str, str]:
    """Names of columns that would all have one name."""
    names = dict.fromkeys(group, name)
    if len(group) == 1:
        return names
    places = {column: Path(row.place).parts for column, row in group.items()}
    if all(places.values()):
        for length in range(1, max(map(len, places.values())) + 1):
            tails = {column: "/".join(parts[-length:]) for column, parts in places.items()}
            if len(set(tails.values())) == len(set(places.values())):
                names = {column: tail + _split(name)[2] for column, tail in tails.items()}
                break
    contents = {column: row.sequence.content[:6] for column, row in group.items()}
    for words in (
        {column: _camera_words(row) for column, row in group.items()},
        {column: f"content {content}" if content else "" for column, content in contents.items()},
        {column: f"frames {column[:6]}" for column in group},
        {column: column for column in group},
    ):
        if len(set(names.values())) < len(names) and len(set(words.values())) > 1:
            names = {
                column: f"{name} ({words[column]})" if words[column] else name
                for column, name in names.items()
            }
    return names


def _camera_words(row: RunRow) -> str:
    """The camera in a few words, empty if the record does not name it."""
    camera = row.identity.get("camera")
    values = (
        [camera.get(name) for name in ("width", "height", "fx", "fy")]
        if isinstance(camera, dict)
        else [None]
    )
    stated = all(isinstance(value, int | float) for value in values)
    return "camera {:g}x{:g}, f {:g} {:g}".format(*values) if stated else ""


OUR_BACK_END = " (our back end)"
OUR_OWN = ", our own"
"""Behind the labels of re-implementations, and of compositions of this project."""
ALWAYS = ("map", "backend.map.localisation_only")
"""Named in any table: a run that begins in a map knows more than one that begins without."""
OF_ALL = {"device", "threads"}
"""Settings that every run has a value of, asked for or not."""


def make_labels(rows: Sequence[RunRow]) -> dict[str, str]:
    """A name for every variant: the tracker's label and what sets it apart from the tracker's other variants.

    What one tracker alone was asked for is named though it has no other variant; what several were,
    as all that a suite runs, is not.
    Behind it stands `SEEN` if any of its runs had masks of a network that was trained on the scene.
    """
    in_training = {row.variant_key for row in rows if row.seen_in_training}
    variants = {
        key: of_key[0] for key, of_key in grouped(rows, lambda row: row.variant_key).items()
    }
    by_tracker = grouped(variants.values(), lambda row: row.tracker.id)
    by_label = grouped(variants.values(), lambda row: row.label)
    named = {
        tracker: {name for row in others for name in row.variant}
        for tracker, others in by_tracker.items()
    }
    shown = {}
    for tracker, others in by_tracker.items():
        elsewhere = set().union(*(names for other, names in named.items() if other != tracker))
        differing = {
            name
            for name in named[tracker]
            if len({str(row.variant.get(name)) for row in others}) > 1
        }
        shown[tracker] = {*ALWAYS, *differing, *(named[tracker] - OF_ALL - elsewhere)}
    texts = {setting_text(value) for row in variants.values() for value in row.variant.values()}
    counts = Counter(map(label_text, texts))

    def spelled(value: Any) -> str:
        """The short form of a value, unless two values have the same."""
        text = setting_text(value)
        return label_text(text) if counts[label_text(text)] == 1 else text

    labels = {}
    for key, row in variants.items():
        tracker = row.tracker.id
        parts = [
            f"{name}={spelled(value)}"
            for name, value in sorted(row.variant.items())
            if name in shown[tracker]
        ]
        parts += [f"{name} {value}" for name, value in sorted(row.split_by.items())]
        parts += ["imported"] * (
            row.imported and not all(other.imported for other in by_tracker[tracker])
        )
        name = (
            f"{row.label} <{tracker}>"
            if len({other.tracker.id for other in by_label[row.label]}) > 1
            else row.label
        )
        labels[key] = (
            name + (f" · {', '.join(parts)}" if parts else "") + f" {SEEN}" * (key in in_training)
        )
    return labels
