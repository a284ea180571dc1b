"""How kernels are compiled: one way for all rooms, which needs no folder to cache in."""

from __future__ import annotations

import re

import numba
import numpy as np
import pytest

from dynslam_bench.core import compiled


@pytest.mark.parametrize("compile_", [compiled.kernel, compiled.dividing_kernel, compiled.spliced])
def test_kernels_compile_where_nothing_can_be_cached(compile_, monkeypatch: pytest.MonkeyPatch) -> None:
    compile_now = numba.njit

    def refuse(**options: object):
        if options.pop("cache", False):
            raise RuntimeError("cannot cache function: no locator available")
        return compile_now(**options)

    monkeypatch.setattr(numba, "njit", refuse)
    assert compile_(lambda x: x + 1)(2) == 3


def test_kernels_are_cached_and_release_the_lock() -> None:
    from dynslam_bench.slam.mapping import map_kernels

    options = map_kernels.project.targetoptions
    assert options["nogil"] and type(map_kernels.project._cache).__name__ != "NullCache"


def test_a_division_by_zero_is_an_error_unless_asked_for() -> None:
    def inverse(x: float) -> float:
        return 1.0 / x

    assert compiled.dividing_kernel(inverse)(0.0) == np.inf
    with pytest.raises(ZeroDivisionError):
        compiled.kernel(inverse)(0.0)


def test_nobody_else_compiles() -> None:
    from documented_names import sources

    found = [str(file) for file in sources() if re.search(r"\bnjit\b", file.read_text(encoding="utf-8"))]
    assert [each for each in found if not each.endswith("core/compiled.py")] == []
