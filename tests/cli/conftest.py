"""The program as the tests of the command line call it, and a small sequence for it."""

import numpy as np
import pytest

from dynslam_bench.cli.app import start
from dynslam_bench.testing import CornerSequence


@pytest.fixture
def cli(capsys, monkeypatch, tmp_path):
    """Runs the program in an empty folder; returns exit code, output and errors."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("DYNSLAM_BENCH_DATA", raising=False)

    def call(*arguments):
        with pytest.raises(SystemExit) as ended:
            start([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return ended.value.code or 0, captured.out, captured.err

    return call


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """The conformance scene as a folder in TUM layout."""
    import cv2

    from dynslam_bench.geometry.trajectory_files import write_tum
    from dynslam_bench.sequences.cameras import write_camera

    scene, folder = CornerSequence(4), tmp_path_factory.mktemp("data") / "walk"
    lists = {"rgb": [], "depth": []}
    for kind in lists:
        (folder / kind).mkdir(parents=True)
    for frame in (scene[i] for i in range(len(scene))):
        images = {"rgb": frame.rgb[..., ::-1], "depth": np.round(frame.depth * 5000).astype(np.uint16)}
        for kind, image in images.items():
            cv2.imwrite(str(folder / kind / f"{frame.index}.png"), image)
            lists[kind].append(f"{frame.timestamp:.6f} {kind}/{frame.index}.png")
    for kind, lines in lists.items():
        (folder / f"{kind}.txt").write_text("\n".join(lines))
    write_tum(folder / "groundtruth.txt", scene.ground_truth)
    write_camera(folder / "camera.toml", scene.camera, fps=30)
    return folder
