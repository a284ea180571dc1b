"""A COCO annotation file with one image and one object."""

import json
from pathlib import Path

import cv2
import numpy as np


def coco(folder: Path, segmentation: object, *, changes: dict[str, object] | None = None, **extra: object) -> Path:
    """The file; `extra` are fields of the annotation, `changes` replace whole parts."""
    cv2.imwrite(str(folder / "a.png"), np.zeros((6, 8, 3), np.uint8))
    content = {
        "images": [{"id": 1, "file_name": "a.png"}],
        "categories": [{"id": 1, "name": "person"}],
        "annotations": [{"image_id": 1, "category_id": 1, "segmentation": segmentation, **extra}],
    }
    path = folder / "annotations.json"
    path.write_text(json.dumps(content | (changes or {})))
    return path
