"""Sequences described for people: lists, and everything known of one."""

from __future__ import annotations

import fnmatch
from collections.abc import Sequence as PySequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.core.folders import find_data_root

from .catalogue import catalogue, entry_of, open_sequence
from .published.datasets import DATASETS
from .synthetic import parse_synthetic_id

KNOWN = "known: another archive is refused"
FIRST_USE = "not published: the first fetch takes it, every later one has to bring the same"


@dataclass(frozen=True)
class Summary:
    """One line of the list of sequences.

    Attributes:
        id: Its id.
        here: Whether it is on this machine; rendered ones are always.
        size: Size of the archive, for people.
        tags: For example ``high-dynamic``.
        split: ``tune``, ``held-out`` or empty.
        ground_truth: Whether the ground truth is public.
        license: Licence of the data.
        url: Where the archive lies.
        dataset: Name of the data set.
        layout: How its files were known when the reader was written: ``verified``, ``not verified`` on the publisher's
            files, or empty where there are none.
        by_hand: Why this program cannot fetch it; empty where it can.
        checksum: Whether its checksum is known before it is fetched; None for what is rendered.
    """

    id: str
    here: bool
    size: str = ""
    tags: tuple[str, ...] = ()
    split: str = ""
    ground_truth: bool = True
    license: str = ""
    url: str = ""
    dataset: str = ""
    layout: str = ""
    by_hand: str = ""
    checksum: bool | None = None


def summaries(*, data_root: str | Path | None = None) -> list[Summary]:
    """All listed sequences.

    Args:
        data_root: Folder of the sequences.
    """
    root, entries, found = find_data_root(data_root), catalogue(), []
    for dataset in DATASETS.all():
        for name in dataset.spec.sequences:
            entry = entries.get(name)
            if entry is None:
                rendered = dataset.spec.id == "synthetic"
                tags = parse_synthetic_id(name).tags if rendered else ()
                split = parse_synthetic_id(name).split if rendered else ""
                size = "rendered" if rendered else ""
                title, licence = dataset.spec.summary or dataset.spec.id, dataset.spec.license
                found.append(Summary(name, True, size, tags, split, license=licence, dataset=title))
                continue
            layout = "verified" if entry.verified else "not verified"
            found.append(
                Summary(
                    name, entry.find(root) is not None, entry.size_text(), entry.tags, entry.split, entry.ground_truth,
                    entry.license, entry.url, entry.title, layout, entry.by_hand, entry.sha256 is not None,
                )
            )  # fmt: skip
    return found


def describe(name: str, *, data_root: str | Path | None = None, camera: str | Path | None = None) -> dict[str, Any]:
    """Everything known of a sequence: the catalogue's entry, and what it holds if it is here.

    Args:
        name: Id, published folder name or path.
        data_root: Folder of the sequences.
        camera: In place of what the catalogue or the folder says.

    Raises:
        SequenceError: Unknown name, or it is here but damaged.
    """
    root, entry = find_data_root(data_root), entry_of(name)
    facts: dict[str, Any] = {}
    if entry is not None:
        facts = {
            "id": entry.id, "alias": entry.folder, "url": entry.url, "page": entry.page, "size": entry.size_text(),
            "size_bytes": entry.size_bytes, "sha256": entry.sha256, "license": entry.license,
            "checksum": KNOWN if entry.sha256 else FIRST_USE,
            "citation": entry.citation, "tags": list(entry.tags), "split": entry.split,
            "ground_truth": "public" if entry.ground_truth else "not public",
            "camera": repr(entry.intrinsics() or "as its files or its layout state"),
            "layout": f"{entry.layout}: {'' if entry.verified else 'not '}verified on the publisher's files",
            "remark": entry.remark,
        }  # fmt: skip
        if entry.find(root) is None:
            return facts | {"here": False, "fetch": entry.how_to_get()}
    sequence = open_sequence(name, data_root=data_root, camera=camera)
    truth = sequence.ground_truth
    dropped, folder = getattr(sequence, "dropped", None), getattr(sequence, "folder", None)
    stamps = sequence.timestamps
    return facts | {
        "id": sequence.id,
        "here": True,
        "folder": None if folder is None else str(folder),
        "frames": len(sequence),
        "duration_s": round(float(stamps[-1] - stamps[0]), 3),
        "fps": round(sequence.fps, 3),
        "camera": repr(sequence.camera),
        "ground_truth_poses": 0 if truth is None else len(truth),
        "path_length_m": None if truth is None else round(truth.path_length_m, 3),
        "masks": "exact" if sequence.masks is not None else "none",
        "license": sequence.license,
        "citation": sequence.citation,
        "association": None if dropped is None else dropped.describe(),
        "digest": sequence.digest(),
    }


def expand(names: PySequence[str]) -> list[str]:
    """Ids that match patterns such as ``bonn/*``; everything else stays as it is.

    Raises:
        SequenceError: A pattern matches nothing.
    """
    expanded: list[str] = []
    for name in names:
        if any(character in name for character in "*[") and not Path(name).exists():
            matching = fnmatch.filter(catalogue(), name)
            if not matching:
                raise SequenceError(f"no public sequence matches '{name}'", "see: dynslam-bench sequences list")
            expanded += matching
        else:
            expanded.append(name)
    return list(dict.fromkeys(expanded))
