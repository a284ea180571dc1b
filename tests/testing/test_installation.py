"""What the program says is installed, and how to get what is not."""

from __future__ import annotations

import json
from importlib import metadata

import pytest

from dynslam_bench.cli.app import start
from dynslam_bench.core.folders import WEIGHTS_VARIABLE
from dynslam_bench.testing import installation
from dynslam_bench.testing.installation import examine


def test_missing_packages_extras_and_weights_are_named_with_a_way_to_get_them(monkeypatch, tmp_path) -> None:
    def version(name: str) -> str:
        if name in ("gtsam", "pandas"):
            raise metadata.PackageNotFoundError(name)
        return "1.2.3"

    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path))
    monkeypatch.setattr(installation.metadata, "version", version)
    monkeypatch.setattr(
        installation.metadata,
        "requires",
        lambda _: ["numpy>=1.26", "pandas>=2.0", "gtsam>=4.2; extra == 'gtsam'", "ruff; extra == 'lint'",
                   "tomli>=2; python_version < '3.11'"],
    )  # fmt: skip
    found = {(each.part, each.name): each for each in examine()}
    assert found["package", "numpy"].state == "1.2.3" and not found["package", "numpy"].missing
    assert found["package", "pandas"].missing and "pip install" in found["package", "pandas"].hint
    assert found["extra", "gtsam"].hint == "pip install '.[gtsam]' in the checkout of dynslam-bench"
    assert ("extra", "lint") not in found
    coco = found["weights", "coco"]
    assert coco.missing and "https://" in coco.hint and str(tmp_path) in coco.hint
    assert not found["weights", "embedded"].missing


def test_the_verb_writes_a_page_and_json(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        start(["doctor", "--json"])
    assert ended.value.code == 0
    rows = json.loads(capsys.readouterr().out)
    assert {"program", "weights", "folder", "device"} <= {row["part"] for row in rows}
    with pytest.raises(SystemExit) as ended:
        start(["doctor"])
    assert ended.value.code == 0 and "embedded" in capsys.readouterr().out
