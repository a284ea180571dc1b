"""The pictures at the top of the README, out of a leaderboard and a run.

    python tests/benchmarks/readme_pictures.py SITE RESULTS

`SITE` is a published site (`dynslam-bench report publish`); `RESULTS` holds one run of a tracker
that culls, e.g. with
`dynslam-bench run emfoa-oft 'synthetic/walking_xyz?scene=100' --frames 0:60 --snapshots`. Headless
Chromium draws both.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import cv2

ROOT = Path(__file__).resolve().parents[2]
PICTURES = ROOT / "docs" / "pictures"
sys.path.insert(0, str(ROOT / "tests"))

from helpers.reports_browser import Browser  # noqa: E402

from dynslam_bench.reports import build_report  # noqa: E402
from dynslam_bench.runs import RunStore  # noqa: E402


def framed(browser: Browser, selector: str, target: Path, most: int = 0) -> None:
    """One element of the page as WebP; at most so many pixels high."""
    box = browser.run(
        f"(() => {{ const box = one({selector!r}).getBoundingClientRect();"
        " return [box.x + scrollX, box.y + scrollY, box.width, box.height].map(Math.round); })()"
    )
    browser.picture(target.with_suffix(".png"))
    image = cv2.imread(str(target.with_suffix(".png")))
    target.with_suffix(".png").unlink()
    x, y, width, height = box
    cv2.imwrite(
        str(target),
        image[y : y + min(height, most or height), x : x + width],
        [cv2.IMWRITE_WEBP_QUALITY, 82],
    )


def main() -> None:
    """Draw both."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("site", type=Path)
    parser.add_argument("results", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        browser = Browser(Path(folder) / "browser")
        browser.open(options.site / "leaderboard" / "index.html", 1400)
        browser.until("one('.dt-search input')")
        framed(browser, "main", PICTURES / "leaderboard.webp", most=760)
        store = RunStore(options.results)
        browser.open(
            build_report(store, Path(folder) / "report").run, 1100, anchor=f"#{store.ids()[0]}"
        )
        browser.until("one('#time .main-svg') && one('#picture img').complete")
        browser.settle()
        framed(browser, ".panes", PICTURES / "culling.webp")
        browser.close()


if __name__ == "__main__":
    main()
