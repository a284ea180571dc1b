"""Named benchmark suites, as TOML files."""

from __future__ import annotations

from dynslam_bench.suites.suite import Suite, Variant, load_suite, suite_names

__all__ = ["Suite", "Variant", "load_suite", "suite_names"]
