"""The stage cache: what is put comes back bit for bit, within a bound, among many processes."""

from __future__ import annotations

import multiprocessing
import os
from pathlib import Path

import numpy as np
import pytest

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.stage_cache import StageCache


def test_arrays_and_cost_come_back_bit_for_bit(tmp_path: Path) -> None:
    cache = StageCache(tmp_path)
    arrays = {"a": np.random.default_rng(0).normal(size=(3, 4)), "b": np.array(["person", "chair"])}
    cache.put("masks", "ab12", arrays, 0.25)
    entry = cache.get("masks", "ab12")
    assert entry is not None and entry.cost_s == 0.25
    for name, value in arrays.items():
        np.testing.assert_array_equal(entry.arrays[name], value)
    assert cache.get("masks", "ab13") is None and cache.get("features", "ab12") is None


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 cut short", b"not an archive"])
def test_a_damaged_entry_counts_as_missing_and_goes(tmp_path: Path, damage: bytes) -> None:
    cache = StageCache(tmp_path)
    cache.put("masks", "ab12", {"a": np.arange(9)}, 0.1)
    (path,) = tmp_path.rglob("*.npz")
    path.write_bytes(damage)
    assert cache.get("masks", "ab12") is None
    assert not path.exists()


def test_the_least_recently_used_entries_go_first(tmp_path: Path) -> None:
    cache = StageCache(tmp_path, max_bytes=50_000)
    for number in range(10):
        cache.put("features", f"{number:02d}", {"a": np.zeros(1000)}, 0.0)
        (path,) = tmp_path.rglob(f"{number:02d}.npz")
        os.utime(path, (number, number))
    assert cache.get("features", "00") is not None  # now the latest used
    assert cache.prune() > 0
    assert cache.get("features", "00") is not None and cache.get("features", "01") is None
    assert sum(cache.info().bytes_by_stage.values()) <= 50_000


def test_info_and_clear(tmp_path: Path) -> None:
    cache = StageCache(tmp_path)
    cache.put("features", "aa", {"a": np.zeros(10)}, 0.0)
    cache.put("masks", "bb", {"a": np.zeros(10)}, 0.0)
    assert dict(cache.info().entries_by_stage) == {"features": 1, "masks": 1}
    held = sum(cache.info().bytes_by_stage.values())
    assert cache.clear() == held > 0
    assert dict(cache.info().entries_by_stage) == {}


def _write_many(folder: str, start: int) -> None:
    cache = StageCache(Path(folder), max_bytes=10**9)
    for number in range(start, start + 40):
        cache.put("features", f"{number % 50:03d}", {"a": np.full(500, number % 50)}, 0.0)


def test_many_processes_share_a_cache(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    writers = [context.Process(target=_write_many, args=(str(tmp_path), start)) for start in (0, 10, 30)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
        assert writer.exitcode == 0
    cache = StageCache(tmp_path)
    for number in range(50):
        entry = cache.get("features", f"{number:03d}")
        assert entry is not None
        np.testing.assert_array_equal(entry.arrays["a"], np.full(500, number))
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path.suffix != ".npz"]


def test_an_unwritable_folder_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DynslamError, match="cannot write the stage cache"):
        StageCache(tmp_path / "file").put("features", "aa", {"a": np.zeros(1)}, 0.0)
