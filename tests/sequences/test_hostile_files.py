"""Images and archives that claim to be huge, lists that name files elsewhere, text of ten million lines."""

import gzip
import io
import resource
import struct
import tarfile
import tempfile
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from sequence_folders import make_folder

from dynslam_bench.core.errors import SequenceError, TrajectoryError
from dynslam_bench.core.images import read_image
from dynslam_bench.geometry.trajectory_files import load_tum
from dynslam_bench.sequences import fetch as archives
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.fetch import MANIFEST, verify
from dynslam_bench.sequences.readers.lists import read_image_list


def lying_png(width: int, height: int) -> bytes:
    """A PNG of a few hundred bytes that claims any size, with right checksums."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    pixels = chunk(b"IDAT", zlib.compress(bytes(99)))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + pixels + chunk(b"IEND", b"")


@pytest.mark.parametrize("kind", ["rgb", "depth"])
def test_an_image_that_claims_to_be_huge_costs_nothing(tmp_path: Path, kind: str) -> None:
    folder, *_ = make_folder(tmp_path / "seq")
    (folder / kind / "2.png").write_bytes(lying_png(40_000, 35_000))
    sequence = open_sequence(folder)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(SequenceError, match="is 40000x35000, but"):
        sequence[2]
    with pytest.raises(SequenceError, match=r"claims to be 40000x35000, at most 64 megapixels"):
        read_image(folder / kind / "2.png", kind=SequenceError)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # KB


def test_a_png_whose_chunk_claims_gigabytes_is_refused(tmp_path: Path) -> None:
    data = lying_png(16, 12)
    at = data.index(b"IDAT") - 4
    (tmp_path / "1.png").write_bytes(data[:at] + b"\xff\xff\xff\xff" + data[at + 4 :])
    with pytest.raises(SequenceError, match="is truncated"):
        read_image(tmp_path / "1.png", kind=SequenceError)


@pytest.mark.parametrize("name", ["../secret.png", "/etc/passwd", "rgb/../../secret.png", "a\\..\\b.png"])
def test_lists_name_nothing_outside_their_folder(tmp_path: Path, name: str) -> None:
    folder, *_ = make_folder(tmp_path / "seq")
    cv2.imwrite(str(tmp_path / "secret.png"), np.zeros((24, 32, 3), np.uint8))
    (folder / "rgb.txt").write_text((folder / "rgb.txt").read_text() + f"99.0 {name}\n")
    with pytest.raises(SequenceError, match="does not lie in"):
        open_sequence(folder)


def test_a_manifest_that_leads_outside_is_a_fault(tmp_path: Path) -> None:
    folder, *_ = make_folder(tmp_path / "seq")
    for content in (f"{'0' * 64}  ../../etc/passwd\n".encode(), b"\xff\xfe"):
        (folder / MANIFEST).write_bytes(content)
        (fault,) = verify(str(folder)).faults
        assert "does not lie in" in fault or "is not a text file" in fault


def test_ten_million_lines_are_refused_early_and_cheaply(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_bytes(b"#\n" * 4_000_001)
    with pytest.raises(TrajectoryError, match="has more than 4000000 lines"):
        load_tum(path)
    with pytest.raises(SequenceError, match="has more than 1000000 lines"):
        read_image_list(path)


def refuses(archive: Path, words: str) -> None:
    with tempfile.TemporaryDirectory() as target, pytest.raises(SequenceError, match=words):
        archives.extract(archive, Path(target))


def test_a_bomb_is_refused(tmp_path: Path) -> None:
    archive = tmp_path / "bomb.zip"
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file, file.open("zeros", "w", force_zip64=True) as out:
        for _ in range(150):
            out.write(bytes(1_000_000))
    refuses(archive, "unpacks to more than")


def tar_header(name: bytes, size: int, kind: bytes) -> bytes:
    """A tar header of any size, with a right checksum."""
    block = bytearray(tarfile.TarInfo(name.decode()).tobuf(tarfile.GNU_FORMAT)[:512])
    block[124:136] = b"\x80" + size.to_bytes(11, "big")
    block[156:157] = kind
    block[148:156] = b" " * 8
    block[148:156] = b"%06o\0 " % sum(block)
    return bytes(block)


@pytest.mark.parametrize("kind", [tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK])
def test_a_tar_header_that_claims_gigabytes_costs_nothing(tmp_path: Path, kind: bytes) -> None:
    archive = tmp_path / "a.tgz"
    archive.write_bytes(gzip.compress(tar_header(b"x", 3 << 30, kind) + bytes(10 << 20), 1))
    refuses(archive, "a header claims 3221225472 bytes")


def test_a_million_empty_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archives, "MAX_MEMBERS", 20)
    archive = tmp_path / "a.tar"
    with tarfile.open(archive, "w") as tar:
        for number in range(30):
            tar.addfile(tarfile.TarInfo(f"seq/{number}"))
    refuses(archive, "holds more than 20 files, refused")
    with zipfile.ZipFile(archive, "w") as made:
        for number in range(30):
            made.writestr(f"zip/{number}", "")
    refuses(archive, "holds more than 20 files, refused")


def test_zeros_after_the_end_of_an_archive_are_counted(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        tar.addfile(tarfile.TarInfo("seq/rgb.txt"))
    archive = tmp_path / "a.tgz"
    archive.write_bytes(gzip.compress(buffer.getvalue(), 1) + gzip.compress(bytes(140_000_000), 9))
    refuses(archive, r"unpacks to more than 0\.1 GB")


def test_other_compressions_are_refused(tmp_path: Path) -> None:
    """LZMA takes as much memory as the file asks for."""
    archive = tmp_path / "a.zip"
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_LZMA) as made:
        made.writestr("seq/rgb.txt", "x")
    refuses(archive, "compressed in a way that is not unpacked here")
