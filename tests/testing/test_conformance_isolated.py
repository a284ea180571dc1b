"""Conformance checks of trackers that exit, hang, crash or leave processes behind: a verdict on every check."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "runs"))

import hostile

from dynslam_bench.core.errors import PluginError
from dynslam_bench.testing import isolated_tracker_report


def report_of(mode, tmp_path=None, target=hostile.TARGET, **options):
    settings = {"mode": mode} | ({} if tmp_path is None else {"pids": str(tmp_path / "pids")})
    return isolated_tracker_report(target, settings=settings, frames=4, **({"frame_s": 3.0} | options))


def failures(report):
    return {check.name: check.message for check in report.failed}


@pytest.mark.parametrize(
    ("mode", "check", "words"),
    [
        ("sys.exit", "results", "called sys.exit(0)"),
        ("os._exit", "results", "the process left with exit code 0 (likely cause: os._exit"),
        ("segfault", "results", "SIGSEGV (segmentation fault)"),
        ("hang", "results", "no sign of life for 3 s (likely cause: an endless loop"),
        ("build-sys.exit", "construction", "called sys.exit(0)"),
        ("build-os._exit", "construction", "the process left with exit code 0"),
    ],
)
def test_a_tracker_that_ends_its_process_fails_the_check(mode, check, words):
    report = report_of(mode)
    assert list(failures(report)) == [check] and words in failures(report)[check]
    assert "\n" not in failures(report)[check]


def test_the_other_checks_go_on():
    """It leaves the process on a black image only: that check fails, all others are made."""
    told = []
    report = report_of("ok", target=f"{hostile.__file__}:BLACK", on_check=told.append)
    assert list(failures(report)) == ["all-black frame"]
    assert told == report.checks and len({check.name for check in told}) == len(told) >= 14
    assert report.checks[-1].name == "closing" and report.subject == "tracker 'blackhater'"


@pytest.mark.skipif(sys.platform != "linux", reason="needs Linux' subreapers")
def test_nothing_survives(tmp_path):
    assert report_of("children", tmp_path).ok
    pids = [int(line) for line in (tmp_path / "pids").read_text().split()]
    assert len(pids) >= 3
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_a_module_that_exits_when_it_is_loaded(tmp_path):
    (tmp_path / "leaver.py").write_text("import os\nos._exit(0)\n")
    report = report_of("ok", target=f"{tmp_path}/leaver.py:SPEC")
    assert list(failures(report)) == ["loading"] and "exit code 0" in failures(report)["loading"]


def test_unknown_names_are_errors_and_no_verdicts():
    with pytest.raises(PluginError, match=r"unknown tracker 'orb-slam'.*orb-slam2"):
        isolated_tracker_report("orb-slam")
    report = isolated_tracker_report("never-move", settings={"speed": 1})
    assert "unknown setting 'speed'" in failures(report)["spec"]
