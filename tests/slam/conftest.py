"""Fixtures of the back end's tests."""

import pytest
from helpers.point_world import PointWorld


@pytest.fixture
def room():
    return PointWorld()
