"""How kernels are compiled: one way for all rooms, which needs no folder to cache in."""

from types import SimpleNamespace

import numba
import numpy as np
import pytest

from dynslam_bench.core import compiled


@pytest.mark.parametrize("compile_", [compiled.kernel, compiled.dividing_kernel, compiled.spliced])
def test_kernels_compile_where_nothing_can_be_cached(compile_, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**options: object):
        if options.pop("cache", False):
            raise RuntimeError("cannot cache function: no locator available")
        return numba.njit(**options)

    monkeypatch.setattr(compiled, "numba", SimpleNamespace(njit=refuse))
    assert compile_(lambda x: x + 1)(2) == 3


def test_kernels_are_cached_and_release_the_lock() -> None:
    from dynslam_bench.slam.pose_optimisation import apply_twist

    options = apply_twist.targetoptions
    assert options["nogil"] and apply_twist.stats.cache_path


def test_kernels_on_disk_are_loaded_before_they_are_called(monkeypatch: pytest.MonkeyPatch) -> None:
    def twice(x: float) -> float:
        return 2 * x

    monkeypatch.setattr(compiled, "_CACHED", [])
    compiled.kernel(twice)(1.0)
    again = compiled.kernel(twice)
    compiled.load_kernels()
    assert again.signatures == [(numba.float64,)] and not again.stats.cache_misses


def test_a_division_by_zero_is_an_error_unless_asked_for() -> None:
    @compiled.dividing_kernel
    def like_numpy(x: float) -> float:
        return 1.0 / x

    @compiled.kernel
    def like_python(x: float) -> float:
        return 1.0 / x

    assert like_numpy(0.0) == np.inf
    with pytest.raises(ZeroDivisionError):
        like_python(0.0)
