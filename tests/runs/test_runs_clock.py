"""The wall's clock jumps, forwards and backwards, while runs are made, waited for and stored, and studies kept."""

from __future__ import annotations

import threading
import time
from itertools import cycle

import pytest
from envs_toys import TARGET

from dynslam_bench.runs import RunSpec, RunStore, resolve, run_many


@pytest.fixture(autouse=True)
def jumps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eleven days forwards, then backwards, at every look at the clock."""
    now, away = time.time, cycle((1e6, -1e6))
    monkeypatch.setattr(time, "time", lambda: now() + next(away))
    assert abs(time.time() - time.time()) > 1e6


def test_runs_are_made_waited_for_and_kept(store: RunStore, toy_folder: str) -> None:
    specs = [RunSpec(tracker=TARGET, sequence=toy_folder, frames=(0, 8), seed=seed) for seed in range(2)]
    with store.work_folder("0" * 16) as work, store.claim(resolve(specs[0]).run_id) as mine:
        assert mine
        began = time.monotonic()
        made: list = []
        thread = threading.Thread(target=lambda: made.extend(run_many(specs, results=store)))
        thread.start()
        while len(store.ids()) < 1 and time.monotonic() - began < 300:
            time.sleep(0.02)
        RunStore(store.root).prepare()  # sweeps what nobody holds
        assert work.is_dir() and store.ids() == [resolve(specs[1]).run_id]  # the other one is being made elsewhere
    thread.join(300)
    assert [record.status for record in made] == ["ok", "ok"]
    assert all(0 < record.wall_s < 900 and 0 < record.timings["total"].mean_s < 900 for record in made)
