"""Runs that keep their map, and runs that begin in one: which map it was is part of what they are."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from dynslam_bench.contracts.tracker import KeyframeRecord, MapOutputs
from dynslam_bench.core.errors import RunError, SettingsError, TrackerError
from dynslam_bench.envs import SlamEnv
from dynslam_bench.evaluation.protocol import get_protocol
from dynslam_bench.reports.model.board import make_board
from dynslam_bench.reports.model.names import make_labels
from dynslam_bench.reports.model.row import make_row, run_command
from dynslam_bench.runs import RunSpec, RunStore, run_many
from dynslam_bench.runs.artifacts import keep_map
from dynslam_bench.runs.identity import check_unchanged, resolve, start_map_of
from dynslam_bench.runs.store import run_row, runs_frame
from dynslam_bench.slam.map_files import MAP_FILE, SavedMap, read_map, write_map
from dynslam_bench.slam.settings import BackendSettings, StartMapSettings

SEQUENCE = "synthetic/walking_xyz"
PLAIN = RunSpec(tracker="orb-slam2", sequence=SEQUENCE, frames=(0, 3), save_map=True)


def begun(file: Path, **changes: object) -> RunSpec:
    """A run on later frames of the scene that begins in a map and leaves it alone."""
    settings = {"backend.map.file": str(file), "backend.map.localisation_only": True}
    return PLAIN.model_copy(update={"frames": (3, 6), "settings": settings, **changes})


def test_a_run_begins_in_the_map_of_another_and_says_so(store: RunStore, tmp_path: Path) -> None:
    file = tmp_path / MAP_FILE
    first = SlamEnv(SEQUENCE, "orb-slam2", frames=(0, 3))
    with pytest.raises(TrackerError, match="has not begun"):
        first.save_map(file)
    first.reset(seed=0)
    first.step(0)
    first.save_map(str(file), "another run")
    (found,) = run_many([begun(file)], results=store)
    assert found.status == "ok" and found.n_tracked == 3 and found.maps == 1
    own = read_map(store.folder(found.run_id) / MAP_FILE)
    assert "frames 3:6, seed 0" in own.header.made_by
    assert all(own.arrays[name].tobytes() == array.tobytes() for name, array in read_map(file).arrays.items())
    begun_in = found.start_map
    assert begun_in is not None and begun_in.localisation_only and begun_in.made_by == "another run"
    assert (begun_in.keyframes, begun_in.points) == (found.keyframes, found.map_points)
    assert any("of another run, localisation only" in note for note in found.notes)
    keyframes = (store.folder(found.run_id) / "keyframes.csv").read_text().splitlines()
    assert len(keyframes) == 1 + found.keyframes and all(line.split(",")[1:3] == ["", ""] for line in keyframes[1:])

    copy, link = tmp_path / "copy.npz", tmp_path / "latest"
    copy.write_bytes(file.read_bytes())
    link.symlink_to(file)
    assert resolve(begun(copy)).run_id == found.run_id, "what counts is the map, not where it lies"
    assert begun(link).absolute().settings["backend.map.file"] == str(file), "another run moves the link"
    asked = found.asked
    assert asked == found.model_copy(update={"overrides": {"backend.map.localisation_only": "true"}}).asked

    other = tmp_path / "other.npz"  # another map at the same path is another run, and no repeat of the first
    changed = SavedMap(read_map(file).header.model_copy(update={"made_by": "somebody"}), read_map(file).arrays)
    write_map(other, changed)
    other.replace(file)
    again = resolve(begun(file))
    assert again.run_id != found.run_id and again.start_map is not None
    with pytest.raises(RunError, match="has changed since the run was asked for"):
        check_unchanged(begun_in, again.settings)
    row = make_row(store, found, get_protocol("tum-rgbd/v1"))
    other_map = found.model_copy(update={"start_map": again.start_map})
    assert row.variant_key != make_row(store, other_map, get_protocol("tum-rgbd/v1")).variant_key
    assert not row.ranked, "it knows more than one that begins without"
    assert make_board([row]).reference is None
    name = f"map={begun_in.digest[:8]}"
    assert name in make_labels([row])[row.variant_key], "named though no other variant stands beside it"
    assert f"--map {file}" in run_command(row) and "backend.map.localisation_only=true" in run_command(row)
    for said in (run_row(found, None)["settings"], runs_frame([(found, None)])["settings"][0]):
        assert f"map={begun_in.digest[:8]}" in said


def test_a_map_that_does_not_fit_is_refused_before_the_run(store: RunStore, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="which is no file"):
        run_many([begun(tmp_path / "none.npz")], results=store)
    (tmp_path / "odd.npz").write_bytes(b"no archive")
    with pytest.raises(SettingsError, match="holds no arrays"):
        run_many([begun(tmp_path / "odd.npz")], results=store)
    assert not store.ids()


def test_a_tracker_without_a_map_says_why_there_is_no_file(store: RunStore) -> None:
    (record,) = run_many([PLAIN.model_copy(update={"tracker": "never-move"})], results=store)
    assert record.status == "ok" and record.maps is None
    assert record.notes == [f"no {MAP_FILE}: tracker 'never-move' cannot save its map"]


def test_maps_that_never_met_are_said(tmp_path: Path) -> None:
    numbers = [0, 0, 1, 1, 1, 3]
    keyframes = tuple(KeyframeRecord(i, i, i / 30, np.eye(4), 9, 9, number) for i, number in enumerate(numbers))
    none = np.zeros(0, np.int64)
    outputs = MapOutputs(keyframes, none, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), none)
    spec = RunSpec(tracker="a", sequence="b")
    _, counts, notes = keep_map(SimpleNamespace(map_outputs=lambda: outputs, exact_stamps={}), tmp_path, spec)
    assert counts["maps"] == 3
    assert notes[0].startswith("3 maps that never met: 4 of 6 keyframes lie in others than the first")
    one = MapOutputs(keyframes[:2], none, outputs.positions, outputs.colours, none)
    _, counts, notes = keep_map(SimpleNamespace(map_outputs=lambda: one, exact_stamps={}), tmp_path, spec)
    assert counts["maps"] == 1 and notes == []


def test_features_of_another_kind_begin_in_no_map() -> None:
    backend = BackendSettings(map=StartMapSettings(file="map.npz"))
    with pytest.raises(SettingsError, match="features are none that maps are made of"):
        start_map_of(SimpleNamespace(backend=backend, features=None), None, "rgbd", {})
