"""A kill, a full or read-only disk, a removed folder at every file operation: one clear error, then all goes on."""

from __future__ import annotations

import http.server
import os
import signal
import tempfile
import threading
from pathlib import Path

import numpy as np
import pytest
from faults import survey, tree

from dynslam_bench.core.download import download
from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.files import (
    TemporaryFolder,
    atomic_folder,
    claimed,
    is_abandoned,
    replace_folder,
    sweep,
    sweep_temporary,
    write_atomic,
)
from dynslam_bench.core.stage_cache import StageCache

BODY = bytes(range(256)) * 40


def swept(root: Path) -> dict[str, bytes | str]:
    """What is left once those have swept up who come a minute later."""
    for new in root.rglob(".*.new"):
        os.utime(new, (0, 0))
    for folder in [root, *(path for path in root.rglob("*") if path.is_dir())]:
        sweep_temporary(folder)
    return tree(root)


def test_a_file_is_the_old_one_or_the_new_one(tmp_path: Path) -> None:
    root = tmp_path / "root"
    path = root / "deep" / "file.txt"
    found = survey(
        lambda: write_atomic(path, "new " * 1000),
        root,
        begin=lambda: write_atomic(path, "old"),
        halfway=lambda: _one_of(path.read_text(), "old", "new " * 1000),
        result=lambda: swept(root),
    )
    assert found.operations >= 4 and found.faults == 4 * found.operations
    assert found.ends["kill", -9] == found.operations and found.ends["full", 3] > 0 and found.ends["read-only", 3] > 0


def test_a_folder_is_the_old_one_or_the_new_one(tmp_path: Path) -> None:
    root = tmp_path / "root"

    def write(text: str) -> None:
        try:
            with atomic_folder(root / "folder") as work:
                for name in ("a", "b"):
                    (work / name).write_text(text + name)
        except OSError as error:  # of the block's own
            raise DynslamError(str(error)) from error

    found = survey(
        lambda: write("new"),
        root,
        begin=lambda: write("old"),
        halfway=lambda: _one_of(tree(root / "folder"), *({n: (t + n).encode() for n in "ab"} for t in ("old", "new"))),
        result=lambda: swept(root),
    )
    assert found.operations >= 8 and found.ends["kill", -9] == found.operations


def test_the_cache_never_gives_half_an_entry(tmp_path: Path) -> None:
    root = tmp_path / "stages"
    cache, arrays = StageCache(root), {"a": np.arange(2000)}

    def whole_or_missing() -> None:
        found = cache.get("orb", "ab" * 20)
        assert found is None or (found.arrays["a"] == arrays["a"]).all()

    found = survey(
        lambda: cache.put("orb", "ab" * 20, arrays, 1.0),
        root,
        halfway=whole_or_missing,
        result=lambda: (swept(root).keys(), cache.get("orb", "ab" * 20).arrays["a"].tolist()),
    )
    assert found.operations >= 4 and found.ends["kill", -9] == found.operations


def test_a_download_goes_on_after_any_fault(tmp_path: Path) -> None:
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), _Answers)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    root = tmp_path / "data"
    url = f"http://127.0.0.1:{server.server_port}/file"
    try:
        found = survey(lambda: download(url, root / "file", attempts=1) and None, root, result=lambda: tree(root))
    finally:
        server.shutdown()
    assert tree(root) == {"file": BODY}
    assert found.ends["kill", -9] >= 5 and found.ends["full", 3] > 0  # how many writes it takes depends on the line


class _Answers(http.server.BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        start = int(self.headers.get("Range", "bytes=0-").removeprefix("bytes=").rstrip("-"))
        self.send_response(206 if start else 200)
        self.send_header("Content-Length", str(len(BODY) - start))
        self.send_header("ETag", '"one"')
        if start:
            self.send_header("Content-Range", f"bytes {start}-{len(BODY) - 1}/{len(BODY)}")
        self.end_headers()
        self.wfile.write(BODY[start:])

    def log_message(self, *_: object) -> None:
        """Nothing."""


def test_many_replace_a_folder_at_the_same_time(tmp_path: Path) -> None:
    target, errors = tmp_path / "folder", []

    def replace(number: int) -> None:
        for turn in range(50):
            work = tmp_path / f"work-{number}-{turn}"
            work.mkdir()
            (work / "file").write_text("whole")
            try:
                replace_folder(work, target)
            except OSError as error:
                errors.append(error)

    threads = [threading.Thread(target=replace, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    seen = 0
    while any(thread.is_alive() for thread in threads) or not seen:
        if target.is_dir():
            seen += 1
            assert (target / "file").read_text() == "whole"
    assert errors == [] and [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_a_name_is_claimed_once(tmp_path: Path) -> None:
    with claimed(tmp_path / "x") as first, claimed(tmp_path / "x") as second:
        assert first and not second
    assert not list(tmp_path.iterdir())
    with claimed(tmp_path / "x") as again:
        assert again


def test_temporary_folders_go_with_their_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    mine = TemporaryFolder()
    assert mine.path.stat().st_mode & 0o777 == 0o700 and not is_abandoned(mine.path)
    pid = os.fork()
    if pid == 0:
        other = TemporaryFolder()
        (other.path / "file").write_text("secret")
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(pid, 0)
    assert len(list(tmp_path.iterdir())) == 2
    assert sweep() >= 1
    assert list(tmp_path.iterdir()) == [mine.path]
    mine.close()
    assert not list(tmp_path.iterdir())


def _one_of(found: object, *allowed: object) -> None:
    assert found in allowed
