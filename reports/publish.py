"""A report and a study as a static site: one folder that can be put on any web server, or into a repository."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dynslam_bench.core.errors import ReportError
from dynslam_bench.core.files import write_atomic
from dynslam_bench.evaluation.protocol import Protocol

from .build_report import build_report
from .html.explore import PICTURE_SECONDS
from .html.site import render_site
from .model.rows import OnProgress, unheard

STUDY_PAGE = "index.html"
FRAMES = 100
"""Frames of a run that its published page shows: a site of hundreds of runs has to fit into a repository."""
_KEPT = ("*.html", "*.csv", "*.toml", "csv/*.csv", "data/*")
"""What of a study's folder is published; its runs and its journal are not."""


@dataclass(frozen=True)
class Site:
    """A published site.

    Attributes:
        index: Its first page.
        files: How many files it has.
        size_mb: Their size in MB.
    """

    index: Path
    files: int
    size_mb: float


def publish(
    runs: Sequence[Path],
    output: Path,
    *,
    study: Path | None = None,
    title: str = "Visual SLAM in dynamic scenes",
    note: str = "",
    picture_seconds: float = PICTURE_SECONDS,
    protocol: Protocol | str = "tum-rgbd/v1",
    on_progress: OnProgress = unheard,
) -> Site:
    """Make the report of some results folders, take a study's page beside it, and write a first page for both.

    The site needs nothing outside of its folder, and the command that it shows for itself names no path of this
    machine.

    Args:
        runs: Results folders.
        output: The site's folder; what it holds of an earlier site is replaced, other files are left alone.
        study: Folder of a study with its page; None for none.
        title: Heading.
        note: What a reader should know, shown on the first page.
        picture_seconds: Time that drawing pictures of frames may take; the frames of an earlier site stay.
        protocol: How to evaluate.
        on_progress: As in `build_report`.

    Raises:
        ReportError: There are no runs, or the study's folder holds no page.
        DynslamError: The folder cannot be written.
    """
    output = output.expanduser().absolute()
    if study is not None and not (study / STUDY_PAGE).is_file():
        raise ReportError(f"{study} holds no {STUDY_PAGE}", "make it with: dynslam-bench tune report STUDY.toml")
    for part in ("leaderboard/data", "leaderboard/csv", "study"):
        shutil.rmtree(output / part, ignore_errors=True)
    report = build_report(
        list(runs), output / "leaderboard", protocol=protocol, title=title, command="dynslam-bench report RESULTS",
        picture_seconds=picture_seconds, most_frames=FRAMES, on_progress=on_progress,
    )  # fmt: skip
    for path in (report.data, report.markdown, report.latex):  # for work with the results, not for looking at them
        path.unlink()
    pages = [("leaderboard/index.html", "Leaderboard", "Trackers, sequences, errors, speed and failures.")]
    if study is not None:
        inside = study.resolve()
        found = {path for pattern in _KEPT for path in study.glob(pattern) if path.is_file()}
        for source in sorted(path for path in found if path.resolve().is_relative_to(inside)):  # no link to elsewhere
            target = output / "study" / source.relative_to(study)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)
        pages.append((f"study/{STUDY_PAGE}", "Study", "What tuning the settings gained, and how sure that is."))
    write_atomic(output / "index.html", render_site(title, pages, note))
    write_atomic(output / ".nojekyll", "")
    sizes = [path.stat().st_size for path in output.rglob("*") if path.is_file()]
    return Site(output / "index.html", len(sizes), sum(sizes) / 1e6)
