"""Trackers: the protocol, light specs, the registry, published systems and adapters to foreign ones."""

from dynslam_bench.contracts import Tracker, TrackerContext, TrackerSpec
from dynslam_bench.trackers.registry import TRACKERS, build_tracker

__all__ = ["TRACKERS", "Tracker", "TrackerContext", "TrackerSpec", "build_tracker"]
