"""Archives that want out of their folder, that grow too large, or that are damaged."""

import io
import stat
import tarfile
import zipfile

import pytest
from fetch_server import FOLDER, left_behind, tgz

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.published.archives import extract


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
