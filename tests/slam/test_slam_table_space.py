"""Tables that outgrow the memory they may take lie in files, and nothing else changes."""

import copy
import mmap
import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
from ring_world import RingWorld

from dynslam_bench.slam import table_space
from dynslam_bench.slam.backend import RgbdBackend
from dynslam_bench.slam.settings import BackendSettings, LoopClosingSettings
from dynslam_bench.slam.table_space import SMALL_BYTES, TableSpace

STATM = Path("/proc/self/statm")


def content(shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


@pytest.mark.parametrize("limit", [0, 10**9])
def test_a_grown_table_has_the_same_content_and_zeros_behind_it(limit):
    space, table = TableSpace(limit), content((40, 900, 2))
    told = table.copy()
    for length, axis in ((64, 0), (100, 0), (1000, 1), (150, 0)):
        table = space.grown("a", table, length, axis)
        bigger = np.zeros(table.shape)
        bigger[tuple(slice(0, n) for n in told.shape)] = told
        np.testing.assert_array_equal(table, bigger)
        table[-1, -1] = told_last = content(2, length)
        told = bigger
        told[-1, -1] = told_last
        space.rest()
        np.testing.assert_array_equal(table, told)
    assert space.bytes_in_files == (0 if limit else table.nbytes)
    assert table.flags.c_contiguous and table.flags.writeable


def test_what_rests_leaves_the_memory_and_comes_back():
    if not hasattr(mmap, "MADV_DONTNEED") or not STATM.exists():
        pytest.skip("this system does not say what is resident")

    def resident():
        return int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    space, table = TableSpace(0), content((8, 4))
    table = space.grown("a", table, 500_000)
    table[:] = 1.0
    full = resident()
    space.rest("another")
    assert abs(resident() - full) < 4_000_000
    space.rest("a")
    assert full - resident() > 12_000_000
    table[:] = 1.0
    space.rest("a", rows=250_000)
    assert 6_000_000 < full - resident() < 10_000_000, "the first half"
    space.rest("a", rows=-5)
    space.rest("a", rows=10**9)
    assert full - resident() > 12_000_000
    assert table.sum() == 2_000_000


def test_small_tables_and_small_maps_stay_in_memory():
    space = TableSpace(SMALL_BYTES * 3)
    one = space.grown("one", np.zeros(0, np.uint8), SMALL_BYTES)
    two = space.grown("two", np.zeros(0, np.uint8), SMALL_BYTES - 1)
    assert space.bytes_in_files == 0 and len(one) + len(two) == 2 * SMALL_BYTES - 1
    space.grown("two", two, SMALL_BYTES * 2 + 1)
    assert space.bytes_in_files == SMALL_BYTES * 2 + 1, "the one that grows moves, the other stays"
    space.grown("three", np.zeros(0, np.uint8), SMALL_BYTES - 1)
    assert space.bytes_in_files == SMALL_BYTES * 2 + 1


@pytest.mark.parametrize("when", ["at first", "later"])
def test_without_room_on_disk_the_table_stays_in_memory_and_the_log_says_so(monkeypatch, caplog, when):
    space, table = TableSpace(0), content((300, 100))
    if when == "later":
        table = space.grown("a", table, 400)
        assert space.bytes_in_files == table.nbytes
    told = table.copy()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(table_space.os, "posix_fallocate", full, raising=False)
    table = space.grown("a", table, 1000)
    assert space.bytes_in_files == 0 and "No space left on device" in caplog.text and "0.8 MB" in caplog.text
    np.testing.assert_array_equal(table[: len(told)], told)
    assert not table[len(told) :].any()


def test_a_copy_of_a_space_has_no_files(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    space = TableSpace(0)
    table = space.grown("a", content((300, 100)), 400)
    copied, twin = copy.deepcopy((space, table))
    twin[:] = 7.0
    assert copied.bytes_in_files == 0 and not (table == 7.0).any()
    assert not list(tmp_path.iterdir()), "the files have no name"


def test_poses_do_not_depend_on_where_the_map_lies(monkeypatch):
    world = RingWorld()
    lap = world.lap(60, 0.15)
    settings = BackendSettings(loop_closing=LoopClosingSettings(enabled=True))

    def driven():
        backend = RgbdBackend(settings)
        backend.reset(world.camera, 0)
        for index, pose in enumerate([*lap, *lap[20:40]]):
            frame = world.see(pose, index)
            backend.track(frame, np.ones(len(frame), bool), np.ones(len(frame), np.float32))
        return backend

    in_memory = driven()
    monkeypatch.setattr(table_space, "SMALL_BYTES", 1)
    monkeypatch.setattr(TableSpace.__init__, "__defaults__", (0,))
    in_files = driven()
    assert in_memory.world.space.bytes_in_files == 0 and in_files.world.space.bytes_in_files > 1_000_000
    np.testing.assert_array_equal(in_files.finalize().T_world_cam, in_memory.finalize().T_world_cam)
