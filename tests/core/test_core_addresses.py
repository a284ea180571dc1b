"""Which addresses are fetched from, and that nothing comes from anywhere else, or without end."""

from __future__ import annotations

import http.server
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from dynslam_bench.core.download import check_address, download
from dynslam_bench.core.errors import DownloadError, DynslamError


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
    """``/to?URL`` redirects there; ``/endless`` sends for ever; ``/big`` announces 1 TB."""

    def log_message(self, *_: object) -> None:
        """Say nothing."""

    def do_GET(self) -> None:
        kind, _, target = self.path.partition("?")
        self.send_response(302 if kind == "/to" else 200)
        if kind == "/to":
            self.send_header("Location", target)
        if kind == "/big":
            self.send_header("Content-Length", str(10**12))
        self.end_headers()
        try:
            while kind == "/endless":
                self.wfile.write(bytes(1 << 16))
        except OSError:
            self.close_connection = True


@pytest.fixture(scope="module")
def here() -> Iterator[str]:
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize("target", ["ftp://127.0.0.1/x", "file:///etc/passwd", "gopher://h/x", "data:,x"])
def test_redirects_to_other_schemes_are_refused(here: str, target: str, tmp_path: Path) -> None:
    with pytest.raises(DownloadError, match=r"the server redirects .*, refused|is not allowed"):
        download(f"{here}/to?{target}", tmp_path / "x", attempts=1, timeout_s=5)
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("target", ["https://[::1", "https://host:x/", "http://" + "a" * 70 + "/"])
def test_redirects_to_odd_addresses_are_one_clear_line(here: str, target: str, tmp_path: Path) -> None:
    with pytest.raises(DownloadError, match=r"stopped at 0 bytes|refused"):
        download(f"{here}/to?{target}", tmp_path / "x", attempts=1, timeout_s=5)


@pytest.mark.parametrize("kind", ["endless", "big"])
def test_a_download_has_a_largest_size(here: str, kind: str, tmp_path: Path) -> None:
    with pytest.raises(DownloadError, match=r"is longer than the 0\.00 GB that are expected"):
        download(f"{here}/{kind}", tmp_path / "x", most_bytes=1 << 20, timeout_s=5)
    assert not (tmp_path / "x.part").exists()


def test_a_folder_that_cannot_be_written_is_one_clear_line(here: str, tmp_path: Path) -> None:
    (tmp_path / "x.part.lock").mkdir()
    with pytest.raises(DynslamError, match=r"cannot write .*: Is a directory"):
        download(f"{here}/big", tmp_path / "x")
