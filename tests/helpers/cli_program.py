"""Helpers of the tests of the command line."""

import typer.main

from dynslam_bench.cli.app import app

PROGRAM = typer.main.get_command(app)
"""Typer would make it again for each call."""


def one_line(err):
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert "Traceback" not in err
    return err
