"""The fixture of the tests of programs."""

import shlex
import sys
import textwrap

import pytest
from adapter_programs import PRELUDE

from dynslam_bench.trackers import build_tracker


@pytest.fixture
def program(tmp_path):
    """Makes a tracker of a program's text; all of them are closed at the end."""
    made = []

    def make(text, context=None, **settings):
        path = tmp_path / f"program{len(made)}.py"
        path.write_text(PRELUDE + textwrap.dedent(text))
        command = shlex.join([sys.executable, str(path)])
        made.append(build_tracker(f"subprocess:{command}", settings, context))
        return made[-1]

    yield make
    for tracker in made:
        tracker.close()
