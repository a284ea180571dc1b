"""Every rule of the package with its default settings."""

import importlib
import pkgutil
from functools import partial
from typing import get_args

import dynslam_bench.culling as culling
from dynslam_bench.culling.reseeding import ReseedingFilter
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.segmentation.settings import SegmentationSettings

for module in pkgutil.iter_modules(culling.__path__):
    importlib.import_module(f"{culling.__name__}.{module.name}")

FURTHER = {ReseedingFilter: [FeatureSettings()]}
RULES = {
    kind.__name__: partial(
        kind,
        get_args(kind.__orig_bases__[0])[0](),
        *FURTHER.get(kind, [SegmentationSettings()] * issubclass(kind, culling.ObjectFilter)),
    )
    for kind in {*culling.BaseFilter.__subclasses__(), *culling.ObjectFilter.__subclasses__()}
    - {culling.ObjectFilter}
}
"""What makes each of them, by the name of its class."""
