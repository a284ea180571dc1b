"""What the program says is installed, and how to get what is not."""

from __future__ import annotations

from importlib import metadata

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
    findings = {(finding.part, finding.name): finding for finding in examine()}
    assert findings["package", "numpy"].state == "1.2.3" and not findings["package", "numpy"].missing
    assert findings["package", "pandas"].missing and "pip install" in findings["package", "pandas"].hint
    assert findings["extra", "gtsam"].hint == "pip install '.[gtsam]' in the checkout of dynslam-bench"
    assert ("extra", "lint") not in findings
    coco = findings["weights", "coco"]
    assert coco.missing and "https://" in coco.hint and str(tmp_path) in coco.hint
    assert not findings["weights", "embedded"].missing
