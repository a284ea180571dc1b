"""Fetching against a local server that cuts, lies and refuses; disks that fill up."""

import errno
import hashlib
import io
import shutil
import stat
import tarfile
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest
from fetch_server import FOLDER, NAME, Server, left_behind, tgz
from published_folders import random_poses, write_eth3d

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
    with pytest.raises(DownloadError, match=rf"stopped at 50000 of {len(packed)} bytes: .*run the same command again"):
        get(attempts=3)
    assert not (tmp_path / "root" / "tum").exists()
    server.requests.clear()
    get()
    assert server.requests == ["bytes=50000-"]


def test_a_file_that_changed_on_the_server_begins_anew(get, server, packed):
    server.plan = [{"cut": 5000}, *[{"cut": 0}] * 2]
    with pytest.raises(DownloadError):
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
    with pytest.raises(DownloadError, match=f"has the checksum {right} .{len(packed)} bytes., expected {'0' * 64}"):
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
    with pytest.raises(DownloadError, match=r"the server answers 404 Not Found for http://127.0.0.1"):
        get()
    server.plan = [{"status": 500}] * 3
    with pytest.raises(DownloadError, match=r"stopped at 0 bytes: the server answers 500"):
        get(attempts=3)


def test_no_server(tmp_path):
    with pytest.raises(DownloadError, match=r"stopped at 0 bytes: .*refused"):
        fetch(NAME, data_root=tmp_path, url="http://127.0.0.1:9/x.tgz", attempts=2, wait_s=0.0)
    with pytest.raises(DownloadError, match="has to begin with http"):
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
    with pytest.raises(DownloadError):
        get(attempts=2)
    fill_disk(lambda path, mode: path.name.endswith(".part") and "b" in mode)
    with pytest.raises(DownloadError, match="make room and run the same command again"):
        get()
    monkeypatch.undo()
    server.requests.clear()
    get()
    assert server.requests == ["bytes=40000-"]


def test_too_little_room_is_noticed_at_once(get, monkeypatch, packed, tmp_path):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(total=1, used=1, free=len(packed) - 1))
    with pytest.raises(DownloadError, match=r"GB free, but .* GB are still to download"):
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


# Archives that want out of their folder, that grow too large, or that are damaged.


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


def zipped(files, *extra, name=FOLDER):
    """A zip archive of files, each as path and folder, and of further entries."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for path, folder in files:
            archive.write(path, f"{name}/{path.relative_to(folder).as_posix()}")
        for entry, content in extra:
            archive.writestr(entry, content)
    return buffer.getvalue()


@pytest.fixture
def two_archives(tmp_path, monkeypatch):
    """A sequence whose colour and depth lie in archives of their own, served as ETH3D publishes them."""
    made = tmp_path / "cables_1"
    write_eth3d(made, random_poses(0))
    files = [path for path in made.rglob("*") if path.is_file()]
    depth = [path for path in files if "depth" in path.parts or path.name == "associated.txt"]
    readme = ("cables_1/README", "the same in both")
    parts = ([path for path in files if path not in depth], depth)
    servers = [Server(zipped([(path, made) for path in part], readme, name="cables_1")) for part in parts]
    urls = [server.url.replace(".tgz", f"_{i}.zip") for i, server in enumerate(servers)]
    entry = entry_of("eth3d/cables_1").model_copy(update={"more_urls": (urls[1],)})
    monkeypatch.setattr(fetching, "entry_of", lambda name: entry)
    yield servers, lambda: fetch("eth3d/cables_1", data_root=tmp_path / "root", url=urls[0], wait_s=0.0, timeout_s=5.0)
    for server in servers:
        server.close()


def test_a_sequence_of_two_archives(two_archives, tmp_path):
    place = two_archives[1]()
    assert place == tmp_path / "root" / "eth3d" / "cables_1" and not (place / ".part").exists()
    assert len(open_sequence("eth3d/cables_1", data_root=tmp_path / "root")) == 3
    assert verify("eth3d/cables_1", data_root=tmp_path / "root").ok


def test_two_archives_that_contradict_each_other_are_refused(two_archives, tmp_path):
    servers, get = two_archives
    buffer = io.BytesIO(servers[1].data)
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.writestr("cables_1/rgb.txt", "1.0 rgb/0.png")
    servers[1].data = buffer.getvalue()
    with pytest.raises(SequenceError, match=r"holds another cables_1/rgb\.txt than the first archive, refused"):
        get()
    assert left_behind(tmp_path / "root") == []


LINK = zipfile.ZipInfo(f"{FOLDER}/link")
LINK.external_attr = (stat.S_IFLNK | 0o777) << 16


@pytest.mark.parametrize("entry", [("a/../../evil", "x"), (LINK, "/etc/passwd")])
def test_zip_files(get, server, folder, tmp_path, entry):
    files = [(path, folder) for path in folder.rglob("*")]
    server.data = zipped(files, entry)
    with pytest.raises(SequenceError, match="refused"):
        get()
    assert left_behind(tmp_path) == []
    server.data = zipped(files)
    assert len(open_sequence(get())) == 4


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
