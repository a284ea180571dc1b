"""What the rows of a table are called."""

from __future__ import annotations

from collections.abc import Sequence

from .row import SEEN, RunRow


def make_labels(rows: Sequence[RunRow]) -> dict[str, str]:
    """A name for every variant: the tracker's label and what sets it apart from the tracker's other variants.

    Behind it stands `SEEN` if any of its runs had masks of a network that was trained on the scene.
    """
    seen = {row.variant_key for row in rows if row.seen_in_training}
    variants: dict[str, RunRow] = {}
    for row in rows:
        variants.setdefault(row.variant_key, row)
    labels = {}
    for key, row in variants.items():
        others = [other for other in variants.values() if other.tracker == row.tracker]
        names = sorted({name for other in others for name in other.variant})
        differing = [name for name in names if len({str(other.variant.get(name)) for other in others}) > 1]
        parts = [f"{name}={row.variant[name]}" for name in differing if name in row.variant]
        if row.imported and any(other.kind != row.kind for other in others):
            parts.append("imported")
        same_label = [other for other in variants.values() if other.label == row.label and other.tracker != row.tracker]
        base = f"{row.label} <{row.tracker}>" if same_label else row.label
        labels[key] = base + (f" · {', '.join(parts)}" if parts else "") + f" {SEEN}" * (key in seen)
    return labels
