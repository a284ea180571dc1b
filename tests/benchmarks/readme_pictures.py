"""The pictures at the top of the README, out of a leaderboard and a run.

    python tests/benchmarks/readme_pictures.py SITE RESULTS [-o docs/pictures]

`SITE` is a published site (`dynslam-bench report publish`); `RESULTS` holds one run of a tracker that culls, e.g. with
`dynslam-bench run emfoa-oft 'synthetic/walking_xyz?scene=100' --frames 0:60`. Headless Chromium draws both.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import cv2

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "reports")]

from reports_browser import Browser  # noqa: E402

from dynslam_bench.reports import build_report  # noqa: E402
from dynslam_bench.runs import RunStore  # noqa: E402

QUALITY = 82


def framed(browser: Browser, selector: str, target: Path, most: int = 0) -> None:
    """One element of the page as WebP; at most so many pixels high."""
    box = browser.run(
        f"(() => {{ const box = one({selector!r}).getBoundingClientRect();"
        " return [box.x + scrollX, box.y + scrollY, box.width, box.height]; })()"
    )
    with tempfile.TemporaryDirectory() as folder:
        browser.picture(Path(folder) / "page.png")
        image = cv2.imread(str(Path(folder) / "page.png"))
    x, y, width, height = (round(value) for value in box)
    cut = image[y : y + min(height, most or height), x : x + width]
    target.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(target), cut, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    print(f"{target}: {cut.shape[1]} x {cut.shape[0]}, {target.stat().st_size / 1000:.0f} kB")


def main() -> None:
    """Draw both."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("site", type=Path)
    parser.add_argument("results", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "pictures")
    parser.add_argument("--frame", type=int, default=-1, help="which of the run's pictures, by its number")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        browser = Browser(Path(folder) / "browser")
        browser.open(options.site / "leaderboard" / "index.html", 1400)
        browser.run("all('details').forEach((each) => { each.open = false; })")
        browser.run("all('.figure').forEach(draw)")
        browser.settle()
        framed(browser, "#leaderboard", options.output / "leaderboard.webp", most=760)
        store = RunStore(options.results)
        report = build_report(store, Path(folder) / "report", picture_seconds=60)
        browser.open(report.run, 1100, anchor=f"#{store.ids()[0]}")
        browser.until("one('.thumb canvas')", tries=200)
        browser.run(f"slide(all('#annotations input[type=range]')[0], {options.frame})") if options.frame >= 0 else None
        browser.settle()
        framed(browser, "#s-track .grid-2", options.output / "culling.webp")
        browser.close()


if __name__ == "__main__":
    main()
