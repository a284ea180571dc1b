import subprocess
import sys

import pytest

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.sequences.synthetic import SyntheticId, parse_synthetic_id


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ("", SyntheticId("sitting_rpy", 0, 600, None)),
        *((form, SyntheticId("sitting_rpy", 107, 33)) for form in ("?scene=107&frames=33", "?frames=33&scene=107")),
        ("@107?frames=33", SyntheticId("sitting_rpy", 107, 33)),
        ("?noise=5", SyntheticId("sitting_rpy", noise=5)),
        ("?scene=107&frames=33&noise=5", SyntheticId("sitting_rpy", 107, 33, noise=5)),
        ("?noise=005&scene=107&frames=033", SyntheticId("sitting_rpy", 107, 33, noise=5)),
    ],
)
def test_scene_length_and_noise_are_read_in_any_order(query: str, expected: SyntheticId) -> None:
    parsed = parse_synthetic_id(f"synthetic/sitting_rpy{query}")
    assert parsed == expected == parse_synthetic_id(str(parsed))
    assert parsed.split == ("held-out" if parsed.scene == 107 else "tune")
    assert str(parsed).replace("&frames=33", "").replace("&frames=600", "") == parsed.whole
    assert parsed.whole.endswith("&noise=5") == (parsed.noise == 5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("synthetic/walking_xyz?noise=-1", "noise '-1'"),
        ("synthetic/walking_xyz?noise", "unknown option 'noise'"),
        ("synthetic/walking_xyz?noise=1&noise=2", "names noise twice"),
        ("synthetic/walking_xyz?frames=3&nose=1", "unknown option 'nose=1'"),
        ("synthetic/walking_xyz?", "unknown option ''"),
        ("synthetic/walking_xy", "did you mean 'synthetic/walking_xyz'"),
        ("synthetic/Walking-static", "did you mean 'synthetic/walking_static'"),
        ("synthetic/walking_xyz?scene=200", "0 to 199"),
        ("synthetic/walking_xyz?scene=", "scene ''"),
        ("synthetic/walking_xyz?scene=0-3", "scene '0-3'"),
        ("synthetic/walking_xyz@40?scene=40", "names scene twice"),
        ("synthetic/walking_xyz@200", "0 to 199"),
        ("synthetic/walking_xyz@-1", "0 to 199"),
        ("synthetic/walking_xyz@", "scene ''"),
        ("synthetic/walking_xyz@1.5", "scene '1.5'"),
        ("synthetic/walking_xyz?frames=0", "from 1 to"),
        ("synthetic/walking_xyz?frames=many", "frames 'many'"),
        ("synthetic/walking_xyz?frame=3", "?frames=N"),
        ("tum/walking_xyz", "did you mean"),
        ("", "not the id"),
    ],
)
def test_bad_ids_say_what_is_wrong(text: str, words: str) -> None:
    with pytest.raises(SequenceError, match=r"^[^\n]+$") as caught:
        parse_synthetic_id(text)
    assert words in str(caught.value)


def test_ids_need_neither_numba_nor_opencv() -> None:
    heavy = "('numba', 'cv2', 'torch')"
    code = f"import sys, dynslam_bench.sequences.synthetic; print([m for m in {heavy} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
