"""The stage cache in a whole tracker: the same bits, no network loaded where none is needed, honest times."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dynslam_bench.core.errors import SegmentationError
from dynslam_bench.core.settings import flatten
from dynslam_bench.runs import RunSpec, RunStore, run_many
from dynslam_bench.sequences.synthetic import open_synthetic
from dynslam_bench.trackers import TRACKERS, TrackerContext, build_tracker
from dynslam_bench.trackers.registry import resolve_settings

FRAMES = 4


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory):
    return open_synthetic(f"synthetic/walking_xyz?scene=5&frames={FRAMES}", tmp_path_factory.mktemp("rendered"))


def run(sequence, cache: Path | None, **settings: object):
    """Poses ``[N, 4, 4]`` and the results of a run with the embedded network."""
    context = TrackerContext(sequence_id=sequence.id, cache=None if cache is None else str(cache))
    tracker = build_tracker("emfoa-oft", {"segmentation.source": "embedded", **settings}, context)
    tracker.reset(sequence.camera, rng=np.random.default_rng(0))
    results = [tracker.track(sequence[index]) for index in range(len(sequence))]
    return np.array([result.T_world_cam for result in results]), results


def test_cached_runs_have_the_same_bits_and_load_no_network(
    sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, _ = run(sequence, None)
    cold, filled = run(sequence, tmp_path)
    assert [result.stats["cached_stages"] for result in filled] == [0.0] * FRAMES

    def refuse(*_: object) -> None:
        raise AssertionError("a network was loaded although all masks are stored")

    monkeypatch.setattr("dynslam_bench.segmentation.networks.mask_rcnn_segmenter.build_embedded", refuse)
    warm, found = run(sequence, tmp_path, **{"epipolar.threshold_px": 2.0, "segmentation.confidence": 0.35})
    again, _ = run(sequence, tmp_path)
    assert [result.stats["cached_stages"] for result in found] == [2.0] * FRAMES
    assert np.array_equal(plain, cold) and np.array_equal(plain, again)
    assert warm.shape == plain.shape
    for before, after in zip(filled, found, strict=True):
        cost = before.timings["segmentation"]
        assert after.timings["segmentation"] == pytest.approx(cost, rel=0.5), "told as what it costs, not the look-up"


EXTRACTOR = """
import numpy as np
from dynslam_bench.contracts import FeatureSpec, Keypoints

class Mine:
    def extract(self, gray):
        n = COUNT
        return Keypoints(np.full((n, 2), 30, np.float32), np.zeros(n, np.int32), np.zeros(n, np.float32),
                         np.ones(n, np.float32), np.zeros((n, 32), np.uint8))

def build(settings):
    return Mine()

SPEC = FeatureSpec("mine", f"{__file__}:build")
"""
ASK = """
import sys
from pathlib import Path
import numpy as np
from dynslam_bench.core.stage_cache import StageCache
from dynslam_bench.features.registry import build_extractor
from dynslam_bench.features.registry import CachedExtractor
from dynslam_bench.features.settings import FeatureSettings

settings = FeatureSettings(extractor=sys.argv[1], options={"weights": sys.argv[3]})
cached = CachedExtractor(build_extractor(settings), settings, StageCache(Path(sys.argv[2])), 1)
print(len(cached.extract(np.zeros((60, 60), np.uint8)).xy), cached.hit)
"""


def test_an_edited_extractor_or_other_weights_get_no_old_keypoints(tmp_path: Path) -> None:
    plugin, weights = tmp_path / "mine.py", tmp_path / "net.bin"

    def ask() -> str:
        command = [sys.executable, "-c", ASK, f"{plugin}:SPEC", str(tmp_path / "cache"), str(weights)]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    plugin.write_text(EXTRACTOR.replace("COUNT", "3"))
    weights.write_text("one")
    assert [ask(), ask()] == ["3 False", "3 True"]
    plugin.write_text(EXTRACTOR.replace("COUNT", "5"))
    assert ask() == "5 False"
    weights.write_text("three")
    assert ask() == "5 False"


def test_a_missing_file_is_an_error_at_once_with_the_cache_too(sequence, tmp_path: Path) -> None:
    with pytest.raises(SegmentationError, match=r"nowhere\.onnx"):
        run(sequence, tmp_path, **{"segmentation.source": f"onnx:{tmp_path / 'nowhere.onnx'}"})


# The presets that ship: they fit, change something and act in a run.


SHIPPED = [(found.spec.id, name) for found in TRACKERS.all() for name in found.spec.presets]


@pytest.mark.parametrize(("tracker", "name"), SHIPPED)
def test_each_sets_something_else_than_the_default(tracker, name):
    spec = TRACKERS.get(tracker)
    default, chosen = flatten(spec.settings()), flatten(resolve_settings(spec, spec.presets[name]))
    changed = {key for key in chosen if chosen[key] != default[key]}
    assert changed and changed <= set(spec.presets[name])


@pytest.mark.parametrize(("more", "asked"), [({}, [1, 0, 1, 0, 1, 0, 1]), ({"crowded_share": 0.1}, [1] * 7)])
def test_fast_asks_the_network_on_every_second_frame_but_where_people_cover_the_view(tmp_path, more, asked):
    settings = {"segmentation.source": "oracle", **TRACKERS.get("mask-rcnn").presets["fast"]}
    settings |= {f"segmentation.{name}": value for name, value in more.items()}
    spec = RunSpec(tracker="mask-rcnn", sequence="synthetic/walking_xyz?frames=7", settings=settings)
    (record,) = run_many([spec], results=tmp_path)
    frames = pd.read_csv(RunStore(tmp_path).folder(record.run_id) / "frames.csv")
    assert frames["stat_segmented"].tolist() == asked
