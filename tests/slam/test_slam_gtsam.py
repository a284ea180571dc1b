"""The reference solver is an extra: without it, one clear error."""

import sys

import pytest

from dynslam_bench.core.errors import TrackerError
from dynslam_bench.slam.bundle_adjustment import adjust_bundle_gtsam


def test_without_gtsam_the_error_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)  # as if it were not installed
    with pytest.raises(TrackerError, match=r"solver = gtsam needs .*pip install '\.\[gtsam\]'"):
        adjust_bundle_gtsam(None, 1)
