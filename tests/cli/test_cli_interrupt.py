"""Ctrl-C, SIGTERM and SIGHUP in long commands: they stop at once, say how to go on, and exit with the shell's code."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dynslam_bench.cli import app
from dynslam_bench.core.errors import RunError

HERE = Path(__file__).resolve().parents[1]
SUITE = (
    "trackers = [{tracker!r}]\nsequences = [{folder!r}]\nframes = [0, 4]\n"
    '[settings]\nmode = "hang"\nat = 0\npids = {pids!r}\n'
)
STUDY = (
    "tracker = {tracker!r}\ntune = [{folder!r}]\ntrials = 4\nseeds = [0]\noffsets = [0]\n"
    '[space.fixed]\nmode = "hang"\nat = 0\npids = {pids!r}\n'
)


def attentive():
    """Programs that a script starts in the background ignore Ctrl-C, below `nohup` the end of the terminal too."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.mark.parametrize(
    ("verb", "text", "number"),
    [("bench", SUITE, signal.SIGHUP), ("bench", SUITE, signal.SIGTERM), ("tune run", STUDY, signal.SIGINT)],
)
def test_a_signal_stops_within_two_seconds(walk, tmp_path, verb, text, number):
    tracker = tmp_path / "waits.py"
    tracker.write_text(
        f"import sys; sys.path.insert(0, {str(HERE / 'runs')!r})\n"
        "from pathlib import Path\n"
        "from dynslam_bench.core.settings import tunable\n"
        "from dynslam_bench.trackers import TrackerSpec\n"
        "import hostile, os\n"
        "class WaitsSettings(hostile.HostileSettings):\n"
        "    patience: float = tunable(0.5, low=0.1, high=1.0, meaning='of no use')\n"
        "class Waits(hostile.Hostile):\n"
        "    def act(self, mode):\n"
        "        self.note(os.getpid())\n"
        "        super().act(mode)\n"
        "SPEC = TrackerSpec('waits', f'{__file__}:Waits', 'Waits', settings=WaitsSettings)\n"
    )
    pids = tmp_path / "pids"
    values = {"tracker": f"{tracker}:SPEC", "folder": str(walk), "pids": str(pids)}
    (tmp_path / "what.toml").write_text(text.format(**values).replace("'", '"'))
    command = [sys.executable, "-m", "dynslam_bench", *verb.split(), "what.toml"]
    program = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, preexec_fn=attentive)
    try:
        deadline = time.monotonic() + 300
        while not (pids.is_file() and pids.read_text().endswith("\n")):
            assert program.poll() is None, program.stderr.read()
            assert time.monotonic() < deadline
            time.sleep(0.1)
        program.send_signal(number)
        began = time.monotonic()
        _, err = program.communicate(timeout=60)
        took = time.monotonic() - began
    finally:
        program.kill()
    assert program.returncode == 128 + number and "the same command goes on from there" in err, err
    assert took < 2 + 10 * _crowded(), f"{took:.1f} s"
    assert not Path(f"/proc/{pids.read_text().split()[0]}").exists()
    assert not list(tmp_path.glob("results/runs/*")), "what was interrupted is no outcome"


def _crowded():
    """Whether many processes wait for a processor: two seconds are no measure then."""
    return float(Path("/proc/loadavg").read_text().split()[0]) > 1.5 * (os.cpu_count() or 1)


@pytest.mark.parametrize("error", [ValueError("schema: KeyboardInterrupt"), RunError("cannot load")])
def test_an_error_that_a_library_makes_of_an_interrupt_is_an_interrupt(monkeypatch, capsys, error):
    def fails(**_):
        raise error

    monkeypatch.setattr(app, "app", fails)
    monkeypatch.setattr(app, "interrupted", lambda: True)
    with pytest.raises(SystemExit, match="130"):
        app.start(["eval"])
    assert capsys.readouterr().err.startswith("interrupted")
