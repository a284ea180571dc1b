"""Tune a visual SLAM system in milliseconds: measured runs as a benchmark for optimisers.

>>> import slam_hpo
>>> bench = slam_hpo.load("mask-rcnn")
>>> one = bench.measured(bench.configuration(0), "synthetic/walking_xyz?scene=130", start=0, frames=60)
>>> 0 < one.ate_m < 1
True
"""

from slam_hpo.spaces import FRAMES, SEQUENCES, SPACES, SPLITS, STARTS, Range, SlamHpoError, defaults
from slam_hpo.table import Benchmark, Evaluation, load

__all__ = [
    "FRAMES",
    "SEQUENCES",
    "SPACES",
    "SPLITS",
    "STARTS",
    "Benchmark",
    "Evaluation",
    "Range",
    "SlamHpoError",
    "defaults",
    "load",
]
