"""Fetching against a local server that cuts, lies and refuses; archives that want out; disks that fill up."""

import contextlib
import errno
import hashlib
import http.server
import io
import re
import stat
import tarfile
import threading
import zipfile
from pathlib import Path

import pytest
from sequence_folders import make_folder

from dynslam_bench.core.download import download
from dynslam_bench.core.errors import DownloadError, DynslamError, SequenceError
from dynslam_bench.sequences import fetch as fetching
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.fetch import Receipt, fetch, status, verify
from dynslam_bench.sequences.published.archives import extract

NAME, FOLDER = "tum/fr3/sitting_static", "rgbd_dataset_freiburg3_sitting_static"


class Server:
    """Serves one file; `plan` holds what goes wrong with each of the next requests."""

    def __init__(self, data):
        self.data, self.plan, self.requests, self.etag, self.ranges = data, [], [], '"one"', True
        owner = self

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def log_message(self, *args):
                pass

            def do_GET(self):
                owner.requests.append(self.headers.get("Range"))
                owner.answer(self, owner.plan.pop(0) if owner.plan else {})

        self.http = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.http.serve_forever, args=(0.02,), daemon=True).start()
        self.url = f"http://127.0.0.1:{self.http.server_port}/{FOLDER}.tgz"

    def answer(self, handler, fault):
        handler.close_connection = True
        if "status" in fault:
            handler.send_error(fault["status"])
            return
        start = 0
        wanted = re.fullmatch(r"bytes=(\d+)-", handler.headers.get("Range") or "")
        if wanted and self.ranges and handler.headers.get("If-Range", self.etag) == self.etag:
            start = int(wanted[1])
            if start >= len(self.data):
                handler.send_response(416)
                handler.send_header("Content-Range", f"bytes */{len(self.data)}")
                handler.send_header("Content-Length", "0")
                handler.end_headers()
                return
        body = self.data[start:]
        handler.send_response(206 if start else 200)
        if start:
            handler.send_header("Content-Range", f"bytes {start}-{len(self.data) - 1}/{len(self.data)}")
        handler.send_header("ETag", self.etag)
        if fault.get("chunked"):
            handler.send_header("Transfer-Encoding", "chunked")
            handler.end_headers()
            half = len(body) // 2
            handler.wfile.write(b"%x\r\n" % half + body[:half] + b"\r\n")
            if fault["chunked"] == "whole":
                handler.wfile.write(b"%x\r\n" % len(body[half:]) + body[half:] + b"\r\n0\r\n\r\n")
            return
        handler.send_header("Content-Length", str(len(body) + fault.get("lie", 0)))
        handler.end_headers()
        with contextlib.suppress(ConnectionError):
            handler.wfile.write(body[: fault.get("cut", len(body))])

    def close(self):
        self.http.shutdown()
        self.http.server_close()


def tgz(folder, name=FOLDER, extra=()):
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz", compresslevel=0) as tar:
        tar.add(folder, arcname=name)
        for info, data in extra:
            tar.addfile(info, io.BytesIO(data))
    return buffer.getvalue()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made, *_ = make_folder(tmp_path_factory.mktemp("published") / FOLDER, frames=4, width=640, height=480)
    (made / "camera.toml").unlink()
    return made


@pytest.fixture(scope="module")
def packed(folder):
    return tgz(folder)


@pytest.fixture
def server(packed):
    made = Server(packed)
    yield made
    made.close()


@pytest.fixture
def get(server, tmp_path):
    """Fetches from the server into a fresh root, without waiting between attempts."""

    def call(**how):
        return fetch(NAME, data_root=tmp_path / "root", url=server.url, wait_s=0.0, timeout_s=5.0, **how)

    return call


def left_behind(root):
    """Every file below the root, hidden ones included."""
    return sorted(path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())


def test_fetch_makes_a_sequence_that_opens(get, server, packed, tmp_path):
    seen = []
    place = get(progress=seen.append)
    root = tmp_path / "root"
    assert place == root / "tum" / FOLDER
    assert len(open_sequence(NAME, data_root=root)) == 4
    receipt = Receipt.read(place / "fetched.json")
    assert (receipt.sha256, receipt.size_bytes) == (hashlib.sha256(packed).hexdigest(), len(packed))
    assert not receipt.checked and receipt.files == 11
    assert [p.stage for p in seen if p.done == len(packed)] == ["download", "check"]
    assert seen[-1].stage == "extract"
    assert all(file.startswith(f"tum/{FOLDER}/") for file in left_behind(root))
    assert get() == place and len(server.requests) == 1  # what is there is left alone
    assert stat.S_IMODE((place / "rgb.txt").stat().st_mode) & 0o111 == 0


def test_cut_connections_are_resumed(get, server, packed):
    server.plan = [{"cut": 10_000}, {"cut": 20_000}, {"status": 503}, {"cut": 0}, {}]
    get()
    assert server.requests == [None, "bytes=10000-", *["bytes=30000-"] * 3]


def test_the_next_call_goes_on_where_this_one_stopped(get, server, packed, tmp_path):
    server.plan = [{"cut": 50_000}, *[{"cut": 0}] * 3]
    with pytest.raises(SequenceError, match=rf"stopped at 50000 of {len(packed)} bytes: .*run the same command again"):
        get(attempts=3)
    assert not (tmp_path / "root" / "tum").exists()
    server.requests.clear()
    get()
    assert server.requests == ["bytes=50000-"]


def test_a_killed_download_is_resumed_too(get, server, packed, tmp_path):
    """A dead process leaves a partial file and its notes, nothing else."""
    part = tmp_path / "root" / ".downloads" / f"{FOLDER}.tgz.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(packed[:777])
    part.with_name(part.name + ".json").write_text(f'{{"url": "{server.url}", "etag": "\\"one\\"", "total": null}}')
    get()
    assert server.requests == ["bytes=777-"]


def test_a_file_that_changed_on_the_server_begins_anew(get, server, packed):
    server.plan = [{"cut": 5000}, *[{"cut": 0}] * 2]
    with pytest.raises(SequenceError):
        get(attempts=2)
    server.etag = '"two"'
    server.data = packed + b"\0" * 100
    get()


def test_a_server_without_ranges(get, server):
    server.ranges = False
    server.plan = [{"cut": 50_000}, {"cut": 10_000}]
    get()
    assert len(server.requests) == 3


def test_announced_length_too_long(get, server, packed):
    """The server announces more than it has: a resumed request reveals the true end."""
    server.plan = [{"lie": 1000}]
    get()
    assert server.requests == [None, f"bytes={len(packed)}-"]


def test_announced_length_too_long_without_ranges(get, server, packed, tmp_path):
    server.ranges = False
    server.plan = [{"lie": 1000}] * 9
    with pytest.raises(SequenceError, match=rf"stopped at {len(packed)} of {len(packed) + 1000} bytes"):
        get(attempts=3)
    assert not (tmp_path / "root" / "tum").exists()
    server.plan = []
    get()


def test_announced_length_too_short(get, server, packed, tmp_path):
    server.plan = [{"lie": -3000}]
    with pytest.raises(SequenceError, match=rf"{FOLDER}.tgz is damaged \({len(packed) - 3000} bytes\)"):
        get()
    assert left_behind(tmp_path / "root") == []
    get()


def test_chunked_answers(get, server):
    server.plan = [{"chunked": "cut"}, {"chunked": "whole"}]
    get()
    assert server.requests[0] is None and server.requests[1].startswith("bytes=")


def test_wrong_checksum(get, server, monkeypatch, tmp_path, packed):
    entry = status(NAME).entry
    right = hashlib.sha256(packed).hexdigest()
    monkeypatch.setattr(fetching, "entry_of", lambda name: entry.model_copy(update={"sha256": "0" * 64}))
    with pytest.raises(SequenceError, match=f"has the checksum {right} .{len(packed)} bytes., expected {'0' * 64}"):
        get()
    assert left_behind(tmp_path / "root") == []
    monkeypatch.setattr(fetching, "entry_of", lambda name: entry.model_copy(update={"sha256": right}))
    assert Receipt.read(get() / "fetched.json").checked


def test_the_checksum_can_be_waived(get, monkeypatch):
    entry = status(NAME).entry
    monkeypatch.setattr(fetching, "entry_of", lambda name: entry.model_copy(update={"sha256": "0" * 64}))
    assert not Receipt.read(get(checksum=False) / "fetched.json").checked


def test_refusals(get, server):
    server.plan = [{"status": 404}]
    with pytest.raises(SequenceError, match=r"the server answers 404 Not Found for http://127.0.0.1"):
        get()
    server.plan = [{"status": 500}] * 3
    with pytest.raises(SequenceError, match=r"stopped at 0 bytes: the server answers 500"):
        get(attempts=3)


def test_no_server(tmp_path):
    with pytest.raises(SequenceError, match=r"stopped at 0 bytes: .*refused"):
        fetch(NAME, data_root=tmp_path, url="http://127.0.0.1:9/x.tgz", attempts=2, wait_s=0.0)
    with pytest.raises(SequenceError, match="has to begin with http"):
        fetch(NAME, data_root=tmp_path, url="file:///etc/passwd")


def test_full_disk_while_downloading(get, server, monkeypatch, tmp_path, packed):
    real = Path.open

    def full(self, mode="r", *args, **kwargs):
        file = real(self, mode, *args, **kwargs)
        if self.name.endswith(".part") and "b" in mode:
            write = file.write

            class Full:
                def __enter__(self):
                    return self

                def __exit__(self, *_):
                    file.close()

                def seek(self, to):
                    file.seek(to)

                def write(self, block):
                    room = 40_000 - file.tell()
                    write(block[: max(room, 0)])
                    if len(block) > room:
                        raise OSError(errno.ENOSPC, "No space left on device")

            return Full()
        return file

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(SequenceError, match=r"No space left on device.*make room and run the same command again"):
        get()
    monkeypatch.undo()
    server.requests.clear()
    get()
    assert server.requests == ["bytes=40000-"]


def test_too_little_room_is_noticed_at_once(get, monkeypatch, packed, tmp_path):
    import shutil
    from collections import namedtuple

    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(1, 1, len(packed) - 1))
    with pytest.raises(SequenceError, match=r"GB free, but .* GB are still to download"):
        get()


def test_full_disk_while_extracting(get, server, monkeypatch, tmp_path):
    real = Path.open
    count = 0

    def full(self, mode="r", *args, **kwargs):
        nonlocal count
        if mode == "xb":
            count += 1
            if count == 5:
                raise OSError(errno.ENOSPC, "No space left on device")
        return real(self, mode, *args, **kwargs)

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(SequenceError, match="no room to extract"):
        get()
    monkeypatch.undo()
    assert left_behind(tmp_path / "root") == [f".downloads/{FOLDER}.tgz"]
    server.requests.clear()
    get()
    assert server.requests == []  # the archive was kept


def test_an_unwritable_root(get, tmp_path):
    (tmp_path / "root").write_text("a file")
    with pytest.raises(DynslamError, match="cannot write into"):
        get()


def member(name, kind=tarfile.REGTYPE, link=""):
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, link
    return info


@pytest.mark.parametrize(
    ("info", "words"),
    [
        (member("../outside.txt"), "outside the sequence's folder"),
        (member("/etc/evil"), "outside the sequence's folder"),
        (member(f"{FOLDER}/../../evil"), "outside the sequence's folder"),
        (member(f"{FOLDER}\\..\\evil"), "outside the sequence's folder"),
        (member(f"{FOLDER}/link", tarfile.SYMTYPE, "/etc/passwd"), "a link or device"),
        (member(f"{FOLDER}/hard", tarfile.LNKTYPE, f"{FOLDER}/rgb.txt"), "a link or device"),
        (member(f"{FOLDER}/device", tarfile.CHRTYPE), "a link or device"),
        (member(f"{FOLDER}/pipe", tarfile.FIFOTYPE), "a link or device"),
        (member(f"{FOLDER}/rgb.txt"), "one name twice"),
        (member(f"{FOLDER}/rgb.txt/below"), "one name twice"),
    ],
)
def test_hostile_tar_files(get, server, folder, tmp_path, info, words):
    server.data = tgz(folder, extra=[(info, b"")])
    with pytest.raises(SequenceError, match=words):
        get()
    assert left_behind(tmp_path) == []


@pytest.mark.parametrize("kind", ["traversal", "link", "good"])
def test_zip_files(get, server, folder, tmp_path, kind):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for path in folder.rglob("*"):
            archive.write(path, f"{FOLDER}/{path.relative_to(folder).as_posix()}")
        if kind == "traversal":
            archive.writestr("a/../../evil", "x")
        if kind == "link":
            info = zipfile.ZipInfo(f"{FOLDER}/link")
            info.external_attr = (stat.S_IFLNK | 0o777) << 16
            archive.writestr(info, "/etc/passwd")
    server.data = buffer.getvalue()
    if kind == "good":
        assert len(open_sequence(get())) == 4
        return
    with pytest.raises(SequenceError, match="refused"):
        get()
    assert left_behind(tmp_path) == []


def test_a_bomb_is_refused(tmp_path):
    archive = tmp_path / "bomb.zip"
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file, file.open("zeros", "w", force_zip64=True) as out:
        for _ in range(150):
            out.write(bytes(1_000_000))
    (tmp_path / "out").mkdir()
    with pytest.raises(SequenceError, match="unpacks to more than"):
        extract(archive, tmp_path / "out")


@pytest.mark.parametrize("damage", ["html", "flip", "no list"])
def test_damaged_archives(get, server, packed, folder, tmp_path, damage):
    if damage == "html":
        server.data = b"<html>moved</html>" * 100
    elif damage == "flip":
        middle = len(packed) // 2
        server.data = packed[:middle] + bytes([packed[middle] ^ 255]) + packed[middle + 1 :]
    else:
        server.data = tgz(folder / "rgb")
    with pytest.raises(SequenceError, match=r"holds no rgb\.txt" if damage == "no list" else "is damaged"):
        get()
    assert left_behind(tmp_path) == []
    server.data = packed
    get()


@pytest.mark.parametrize("name", [".", "another_name", "deep/er"])
def test_the_folder_inside_may_have_any_name(get, server, folder, name):
    server.data = tgz(folder, name)
    if name == "deep/er":
        with pytest.raises(SequenceError, match=r"holds no rgb\.txt"):
            get()
    else:
        assert len(open_sequence(get())) == 4


def test_two_at_once(server, tmp_path):
    import fcntl

    target = tmp_path / "file"
    with (tmp_path / "file.part.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(DownloadError, match="another process is downloading"):
            download(server.url, target)
    download(server.url, target)


def test_verify(get, tmp_path):
    place = get()
    root = tmp_path / "root"
    done = []
    report = verify(NAME, data_root=root, progress=lambda at, of: done.append((at, of)))
    assert report.ok and report.manifest and report.frames == 4 and done[-1] == (4, 4)
    image = place / "rgb" / "2.png"
    image.write_bytes(image.read_bytes()[:-300])
    (place / "groundtruth.txt").unlink()
    report = verify(NAME, data_root=root)
    assert [fault.split(" ")[0] for fault in report.faults] == ["frame", "groundtruth.txt", "rgb/2.png"]
    (place / "depth.txt").write_text("")
    assert "lists no image" in verify(NAME, data_root=root).faults[0]


def test_verify_of_folders_and_of_nothing(folder, tmp_path):
    report = verify(str(folder))
    assert report.ok and not report.manifest and report.id == NAME
    with pytest.raises(SequenceError, match="sequences fetch"):
        verify(NAME, data_root=tmp_path)
    with pytest.raises(SequenceError, match="did you mean"):
        fetch("tum/fr3/siting_static", data_root=tmp_path)
    with pytest.raises(SequenceError, match="needs no fetching"):
        fetch("synthetic/walking_xyz", data_root=tmp_path)


def test_status(get, tmp_path):
    before = status(FOLDER, data_root=tmp_path / "root")
    assert before.folder is None and before.entry.id == NAME
    place = get()
    assert status(NAME, data_root=tmp_path / "root").folder == place == before.place
