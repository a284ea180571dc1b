"""Archives that want out of their folder, that grow too large, or that are damaged."""

import io
import stat
import tarfile
import zipfile

import pytest
from fetch_server import FOLDER, Server, left_behind, tgz
from published_folders import random_poses, write_eth3d

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.sequences import fetch as fetching
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.catalogue import entry_of
from dynslam_bench.sequences.fetch import fetch, verify


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
