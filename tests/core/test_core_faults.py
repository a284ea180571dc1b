"""Files, the stage cache and downloads: whole or absent, under a fault at every file operation and odd addresses."""

import contextlib
import http.server
import os
import signal
import tempfile
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat
from pathlib import Path

import numpy as np
import pytest
from faults import in_a_small_process, survey, tree

from dynslam_bench.core.download import check_address, download
from dynslam_bench.core.errors import DownloadError, DynslamError
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


def one_of(value: object, *allowed: object) -> None:
    assert value in allowed


def swept(root: Path) -> dict[str, bytes | str]:
    """What is left once those have swept up who come a minute later."""
    for new in root.rglob(".*.new"):
        os.utime(new, (0, 0))
    for folder in [root, *(path for path in root.rglob("*") if path.is_dir())]:
        sweep_temporary(folder)
    return tree(root)


@in_a_small_process
def test_a_file_is_the_old_one_or_the_new_one(tmp_path: Path) -> None:
    root = tmp_path / "root"
    path = root / "deep" / "file.txt"
    found = survey(
        lambda: write_atomic(path, "new " * 1000),
        root,
        begin=lambda: write_atomic(path, "old"),
        halfway=lambda: one_of(path.read_text(), "old", "new " * 1000),
        result=lambda: swept(root),
    )
    assert found.operations >= 4 and found.ends.total() == 4 * found.operations
    assert found.ends["kill", -9] == found.operations and found.ends["full", 3] > 0 and found.ends["read-only", 3] > 0


@in_a_small_process
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
        halfway=lambda: one_of(tree(root / "folder"), *({n: (t + n).encode() for n in "ab"} for t in ("old", "new"))),
        result=lambda: swept(root),
    )
    assert found.operations >= 8 and found.ends["kill", -9] == found.operations


@in_a_small_process
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


@in_a_small_process
def test_a_download_goes_on_after_any_fault(here: str, tmp_path: Path) -> None:
    root = tmp_path / "data"
    found = survey(
        lambda: download(f"{here}/file", root / "file", attempts=1) and None, root, result=lambda: tree(root)
    )
    assert tree(root) == {"file": BODY}
    assert found.ends["kill", -9] >= 5 and found.ends["full", 3] > 0  # how many writes it takes depends on the line


@pytest.mark.parametrize("can_exchange", [True, False])
def test_many_replace_a_folder_at_the_same_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, can_exchange: bool
) -> None:
    if not can_exchange:  # as on network file systems
        monkeypatch.setattr("ctypes.CDLL", lambda *_, **__: object())
    target = tmp_path / "folder"

    def replace(number: int) -> None:
        for turn in range(50):
            work = tmp_path / f"work-{number}-{turn}"
            work.mkdir()
            (work / "file").write_text("whole")
            replace_folder(work, target)

    with ThreadPoolExecutor(4) as pool:
        writers = [pool.submit(replace, number) for number in range(4)]
        while not all(writer.done() for writer in writers):
            assert not can_exchange or not target.is_dir() or (target / "file").read_text() == "whole"
    assert [writer.result() for writer in writers] == [None] * 4
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


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


def test_arrays_and_cost_come_back_bit_for_bit(tmp_path: Path) -> None:
    cache = StageCache(tmp_path)
    arrays = {"a": np.random.default_rng(0).normal(size=(3, 4)), "b": np.array(["person", "chair"])}
    cache.put("masks", "ab12", arrays, 0.25)
    entry = cache.get("masks", "ab12")
    assert entry is not None and entry.cost_s == 0.25
    for name, value in arrays.items():
        np.testing.assert_array_equal(entry.arrays[name], value)
    assert cache.get("masks", "ab13") is None and cache.get("features", "ab12") is None


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 cut short", b"not an archive"])
def test_a_damaged_entry_counts_as_missing_and_goes(tmp_path: Path, damage: bytes) -> None:
    cache = StageCache(tmp_path)
    cache.put("masks", "ab12", {"a": np.arange(9)}, 0.1)
    (path,) = tmp_path.rglob("*.npz")
    path.write_bytes(damage)
    assert cache.get("masks", "ab12") is None
    assert not path.exists()


def test_the_least_recently_used_entries_go_first(tmp_path: Path) -> None:
    cache = StageCache(tmp_path, max_bytes=50_000)
    for number in range(10):
        cache.put("features", f"{number:02d}", {"a": np.zeros(1000)}, 0.0)
        (path,) = tmp_path.rglob(f"{number:02d}.npz")
        os.utime(path, (number, number))
    assert cache.get("features", "00") is not None  # now the latest used
    assert cache.prune() > 0
    assert cache.get("features", "00") is not None and cache.get("features", "01") is None
    assert sum(cache.info()["bytes_by_stage"].values()) <= 50_000


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("ftp://host/x.tgz", "has to begin with http:// or https://"),
        ("file:///etc/passwd", "has to begin with http:// or https://"),
        ("https://[::1/x", "Invalid IPv6 URL"),
        ("https:///x.tgz", "it is no web address"),
        ("https://host:99999/x", "Port out of range"),
        ("https://host/a b", "it is no web address"),
        ("https://host/\n", "it is no web address"),
        ("https://" + "a" * 70 + ".org/x", "cannot download"),
        ("https://me:s3cret@host/x", "holds a name or password"),
        ("http://host/x.tgz", "http without a known checksum"),
    ],
)
def test_odd_addresses_are_one_clear_line(url: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(DownloadError, match=words) as caught:
        download(url, tmp_path / "x", attempts=1)
    assert "s3cret" not in str(caught.value) and not list(tmp_path.iterdir())


def test_http_is_taken_where_the_content_is_checked_or_on_this_machine() -> None:
    assert check_address("http://host/x.tgz", checked=True).hostname == "host"
    assert check_address("http://127.0.0.1:80/x", checked=False).port == 80
    assert check_address("https://host/x.tgz", checked=False).scheme == "https"


class Handler(http.server.BaseHTTPRequestHandler):
    """``/file`` is `BODY`; ``/to?URL`` redirects there; ``/endless`` sends for ever; ``/big`` announces 1 TB."""

    def log_message(self, *_: object) -> None:
        """Say nothing."""

    def do_GET(self) -> None:
        kind, _, target = self.path.partition("?")
        start = int(self.headers.get("Range", "bytes=0-").removeprefix("bytes=").rstrip("-"))
        headers, body = {
            "/file": (
                {"Content-Length": len(BODY) - start, "ETag": '"one"'}
                | ({"Content-Range": f"bytes {start}-{len(BODY) - 1}/{len(BODY)}"} if start else {}),
                [BODY[start:]],
            ),
            "/to": ({"Location": target}, []),
            "/big": ({"Content-Length": 10**12}, []),
            "/endless": ({}, repeat(bytes(1 << 16))),
        }[kind]
        self.send_response(302 if kind == "/to" else 206 if start else 200)
        for name, value in headers.items():
            self.send_header(name, str(value))
        self.end_headers()
        with contextlib.suppress(OSError):
            self.wfile.writelines(body)


@pytest.fixture(scope="module")
def here() -> Iterator[str]:
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


SCHEMES = r"the server redirects .*, refused|is not allowed"
ADDRESSES = r"stopped at 0 bytes|refused"


@pytest.mark.parametrize(
    ("target", "words"),
    [
        *((target, SCHEMES) for target in ("ftp://127.0.0.1/x", "file:///etc/passwd", "gopher://h/x", "data:,x")),
        *((target, ADDRESSES) for target in ("https://[::1", "https://host:x/", "http://" + "a" * 70 + "/")),
    ],
)
def test_redirects_to_other_schemes_and_odd_addresses_are_refused(
    here: str, target: str, words: str, tmp_path: Path
) -> None:
    with pytest.raises(DownloadError, match=words):
        download(f"{here}/to?{target}", tmp_path / "x", attempts=1, timeout_s=5)
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("kind", ["endless", "big"])
def test_a_download_has_a_largest_size(here: str, kind: str, tmp_path: Path) -> None:
    with pytest.raises(DownloadError, match=r"is longer than the 0\.00 GB that are expected"):
        download(f"{here}/{kind}", tmp_path / "x", most_bytes=1 << 20, timeout_s=5)
    assert not (tmp_path / "x.part").exists()
