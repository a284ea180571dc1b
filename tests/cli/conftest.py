"""The program as the tests of the command line call it, and a small sequence for it."""

import json

import pytest
from helpers.cli_program import PROGRAM
from helpers.envs_toys import write_sequence

from dynslam_bench.cli import app, output
from dynslam_bench.core.folders import digest_cache_folder, kernels_folder, user_cache
from dynslam_bench.testing import CornerSequence


@pytest.fixture
def cli(capsys, monkeypatch, tmp_path):
    """Runs the program in an empty folder; returns exit code, output and errors."""
    monkeypatch.chdir(tmp_path)
    # shared by all tests: compiling the kernels takes minutes, reading this package's code seconds
    shared = [kernels_folder(), digest_cache_folder()]
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    user_cache().mkdir(parents=True)
    for folder in shared:
        folder.mkdir(parents=True, exist_ok=True)
        (user_cache() / folder.name).symlink_to(folder)
    monkeypatch.delenv("DYNSLAM_BENCH_DATA", raising=False)
    monkeypatch.setattr(app, "app", PROGRAM)
    # no lines of progress where the machine is slow
    monkeypatch.setattr(output, "HEARTBEAT_S", 1000.0)

    def call(*arguments):
        with pytest.raises(SystemExit) as ended:
            app.start([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return ended.value.code or 0, captured.out, captured.err

    return call


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """The conformance scene as a folder in TUM layout."""
    return write_sequence(tmp_path_factory.mktemp("data") / "walk", CornerSequence(4))


@pytest.fixture
def facts(cli):
    """Runs the program with ``--json`` and returns what it writes; it exits with `code`, and with 0 without a word."""

    def call(*arguments, code=0):
        ended, out, err = cli(*arguments, "--json")
        assert ended == code, err
        assert code or not err, err
        return json.loads(out)

    return call
