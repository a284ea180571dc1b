"""Fetching against a local server that cuts, lies and refuses; disks that fill up."""

import errno
import hashlib
import shutil
import stat
from pathlib import Path
from types import SimpleNamespace

import pytest
from fetch_server import FOLDER, NAME, left_behind

from dynslam_bench.core.download import download
from dynslam_bench.core.errors import DownloadError, DynslamError, SequenceError
from dynslam_bench.sequences import fetch as fetching
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.catalogue import entry_of
from dynslam_bench.sequences.fetch import Receipt, fetch, verify


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


@pytest.mark.parametrize(
    ("plan", "ranges", "requests"),
    [
        ([{"cut": 10_000}, {"cut": 20_000}, {"status": 503}, {"cut": 0}], True, ["10000", *["30000"] * 3]),
        ([{"cut": 50_000}, {"cut": 10_000}], False, ["50000", "10000"]),
        ([{"lie": 1000}], True, ["end"]),  # more is announced than there is: a resumed request reveals the true end
        ([{"chunked": "cut"}, {"chunked": "whole"}], True, ["half"]),
    ],
)
def test_connections_that_break_are_resumed(get, server, packed, plan, ranges, requests):
    server.plan, server.ranges = list(plan), ranges
    get()
    names = {"end": str(len(packed)), "half": str(len(packed) // 2)}
    assert server.requests == [None, *[f"bytes={names.get(start, start)}-" for start in requests]]


def test_the_next_call_goes_on_where_this_one_stopped(get, server, packed, tmp_path):
    server.plan = [{"cut": 50_000}, *[{"cut": 0}] * 3]
    with pytest.raises(SequenceError, match=rf"stopped at 50000 of {len(packed)} bytes: .*run the same command again"):
        get(attempts=3)
    assert not (tmp_path / "root" / "tum").exists()
    server.requests.clear()
    get()
    assert server.requests == ["bytes=50000-"]


def test_a_file_that_changed_on_the_server_begins_anew(get, server, packed):
    server.plan = [{"cut": 5000}, *[{"cut": 0}] * 2]
    with pytest.raises(SequenceError):
        get(attempts=2)
    server.etag = '"two"'
    server.data = packed + b"\0" * 100
    get()


def test_announced_length_too_short(get, server, packed, tmp_path):
    server.plan = [{"lie": -3000}]
    with pytest.raises(SequenceError, match=rf"{FOLDER}.tgz is damaged \({len(packed) - 3000} bytes\)"):
        get()
    assert left_behind(tmp_path / "root") == []
    get()


def test_wrong_checksum(get, server, monkeypatch, tmp_path, packed):
    entry = entry_of(NAME)
    right = hashlib.sha256(packed).hexdigest()
    monkeypatch.setattr(fetching, "entry_of", lambda name: entry.model_copy(update={"sha256": "0" * 64}))
    with pytest.raises(SequenceError, match=f"has the checksum {right} .{len(packed)} bytes., expected {'0' * 64}"):
        get()
    assert left_behind(tmp_path / "root") == []
    monkeypatch.setattr(fetching, "entry_of", lambda name: entry.model_copy(update={"sha256": right}))
    assert Receipt.read(get() / "fetched.json").checked


def test_without_a_known_checksum_the_first_one_counts(get, server, packed, tmp_path):
    first = hashlib.sha256(packed).hexdigest()
    shutil.rmtree(get())
    shutil.rmtree(get())
    (kept,) = (tmp_path / "root" / ".downloads").iterdir()
    assert kept.read_text() == f"{first}  {server.url}\n"
    kept.write_text(kept.read_text().replace(first, "0" * 64))
    with pytest.raises(SequenceError, match=f"has the checksum {first}, but gave {'0' * 64} before"):
        get()
    assert list((tmp_path / "root" / ".downloads").iterdir()) == [kept]
    assert Receipt.read(get(checksum=False) / "fetched.json").sha256 == first
    assert kept.read_text().startswith(first)


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


@pytest.fixture
def fill_disk(monkeypatch):
    """Makes the disk full when a file is opened for which a function of its path and mode is true."""

    def fill(is_last):
        def full(self, mode="r", *args, **kwargs):
            if is_last(self, mode):
                raise OSError(errno.ENOSPC, "No space left on device")
            return real(self, mode, *args, **kwargs)

        monkeypatch.setattr(Path, "open", full)

    real = Path.open
    return fill


def test_full_disk_while_downloading(get, server, fill_disk, monkeypatch):
    server.plan = [{"cut": 40_000}, *[{"cut": 0}] * 2]
    with pytest.raises(SequenceError):
        get(attempts=2)
    fill_disk(lambda path, mode: path.name.endswith(".part") and "b" in mode)
    with pytest.raises(SequenceError, match="make room and run the same command again"):
        get()
    monkeypatch.undo()
    server.requests.clear()
    get()
    assert server.requests == ["bytes=40000-"]


def test_too_little_room_is_noticed_at_once(get, monkeypatch, packed, tmp_path):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(total=1, used=1, free=len(packed) - 1))
    with pytest.raises(SequenceError, match=r"GB free, but .* GB are still to download"):
        get()


def test_full_disk_while_extracting(get, server, fill_disk, monkeypatch, tmp_path):
    fill_disk(lambda path, mode: mode == "xb" and path.name == "2.png")
    with pytest.raises(SequenceError, match="no room to extract"):
        get()
    monkeypatch.undo()
    assert left_behind(tmp_path / "root") == [f".downloads/{FOLDER}.tgz"]
    server.requests.clear()
    get()
    assert server.requests == []  # the archive was kept


def test_an_unwritable_root(get, tmp_path):
    (tmp_path / "root").write_text("a file")
    with pytest.raises(DynslamError, match="cannot write"):
        get()


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
