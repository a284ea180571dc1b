"""Readers of images, archives and networks."""

import gzip
import io
import lzma
import struct
import tarfile
import zipfile
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import cv2
import numpy as np
import torch

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core import images
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.segmentation import recorded
from dynslam_bench.segmentation.networks import loading
from dynslam_bench.segmentation.networks import onnx_segmenter as onnx
from dynslam_bench.segmentation.networks.backbone import NetworkConfig
from dynslam_bench.segmentation.networks.network import MaskRCNN
from dynslam_bench.segmentation.training.labelled_images import PreparedImages
from dynslam_bench.sequences import fetch as archives
from dynslam_bench.sequences.readers import recorded as reader
from dynslam_bench.sequences.synthetic.sequence import FrameStore, encode_png
from dynslam_bench.trackers.adapters import orbslam3 as vocabulary

from .campaign import Target, at, written
from .mutate import mutate, mutate_png, mutate_zip

CAMERA = Camera(16, 12, 20.0, 20.0, 8.0, 6.0)
SMALL = NetworkConfig(blocks=(1, 1, 1, 1), bottleneck=False, stem=1, channels=1, classes=("person",), box_hidden=1,
                      mask_channels=1, mask_layers=1)  # fmt: skip


def _encoded(*suffixes: str, image: np.ndarray | None = None) -> list[bytes]:
    if image is None:
        image = np.random.default_rng(0).integers(0, 255, (12, 16, 3), np.uint8)
    return [cv2.imencode(suffix, image)[1].tobytes() for suffix in suffixes]


def _colours() -> list[bytes]:
    grey, deep = np.full((12, 16), 80, np.uint8), np.full((12, 16, 3), 999, np.uint16)
    alpha = np.full((12, 16, 4), 80, np.uint8)
    return [*_encoded(".png", ".jpg", ".bmp", ".tiff", ".ppm"), *_encoded(".png", image=grey),
            *_encoded(".png", image=alpha), *_encoded(".png", image=deep), *_odd_headers()]  # fmt: skip


def _odd_headers() -> list[bytes]:
    """Files that claim to be huge, or to be something that they are not."""
    start = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + b"IHDR"
    bitmap = b"BM" + bytes(12) + struct.pack("<IHH", 12, 16, 12) + bytes(99)
    jpeg = b"\xff\xd8\xff\xff\xd0\x00\xff\xc0\x00\x11\x08\xff\xff\xff\xff" + bytes(20)
    cut = _encoded(".png")[0][:-20]
    huge = start + struct.pack(">IIBB", 65535, 60000, 8, 2) + bytes(60) + b"IEND\xaeB`\x82"
    tiff, pnm = b"II*\0\x08\0\0\0\0\0", b"P5 99999 99999 255\n"
    return [huge, start[:20], bitmap, b"BM", jpeg, tiff, pnm, b"no image", cut]


def _depths() -> list[bytes]:
    deep = np.arange(192, dtype=np.uint16).reshape(12, 16) * 90
    metres = _npy(np.full((12, 16), 1.5, np.float32))
    return [metres, *_encoded(".png", ".tiff", ".pgm", image=deep), *_encoded(".png", image=deep[:4]), *_colours()]


def _npy(array: np.ndarray) -> bytes:
    return written(lambda file: np.save(file, array))


def _rendered() -> list[bytes]:
    png = encode_png(np.full((12, 16, 3), 9, np.uint8))
    return [png, png[:-6], png[:-12], png[:30] + b"x" + png[31:], png + b"x"]


def _read_colour(data: bytes | None, folder: Path) -> None:
    path = at(folder, "1.png", data)
    images.read_image(path)  # any size
    image = reader.read_colour(path, size=(16, 12), mismatch="but the camera is 16x12")
    assert image.shape == (12, 16, 3) and image.dtype == np.uint8


def _read_depth(data: bytes | None, folder: Path) -> None:
    path = at(folder, "1.npy" if data and data.startswith(b"\x93") else "1.png", data)
    reader.read_depth(path, 5000.0, missing=90, furthest_m=2.0)  # any size
    image = reader.read_depth(path, 5000.0, size=(16, 12), mismatch="but the camera is 16x12")
    assert image.shape == (12, 16) and image.dtype == np.float32


def _read_mask(data: bytes | None, folder: Path) -> None:
    stamped = data is not None and len(data) % 2 == 0
    at(folder, "0.9.png" if stamped else "0.png", b"")
    at(folder, "1.0.png" if stamped else "1.png", data)
    at(folder, recorded.CLASSES_FILE, b'{"1": "person"}')
    frame = Frame(1, 1.0, np.zeros((12, 16, 3), np.uint8), np.zeros((12, 16), np.float32))
    segmenter = recorded.RecordedSegmenter(folder)
    segmenter.missing(np.array([1.0, 2.0]))
    segmenter.segment(frame)


def _read_rendered(data: bytes | None, folder: Path) -> None:
    store = FrameStore(folder, CAMERA)
    if data == b"":
        (folder / "rgb" / "1.000000.png").mkdir(parents=True)
    else:
        at(folder, "rgb/1.000000.png", data)
    image = store.read("rgb", 1.0)
    assert image is None or image.shape == (12, 16, 3)


def _tar(*members: tuple[str, bytes, bytes], form: int = tarfile.GNU_FORMAT) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=form) as tar:
        for name, content, kind in members:
            info = tarfile.TarInfo(name)
            info.size, info.type = len(content), kind
            tar.addfile(info, io.BytesIO(content))
    return buffer.getvalue()


def _archives() -> list[bytes]:
    plain = ("seq/", b"", tarfile.DIRTYPE), ("seq/rgb.txt", b"1 a\n" * 50, tarfile.REGTYPE)
    long = ("seq/" + "n" * 150 + "/" + "m" * 99, b"x", tarfile.REGTYPE)
    link = ("seq/link", b"", tarfile.SYMTYPE)
    packed = _zip("seq/rgb.txt")
    return [
        *(gzip.compress(_tar(*plain), 1), gzip.compress(_tar(*plain), 1)[:-20], _tar(*plain, long)),
        *(_tar(*plain, long, form=tarfile.PAX_FORMAT), _tar(*plain, *plain), _tar(link), _tar(*plain, *plain[1:])),
        *(packed, packed.replace(b"1 a", b"1 b", 1), _zip("../rgb.txt"), _zip("seq/rgb.txt", zipfile.ZIP_BZIP2)),
        _zip("seq/link", attributes=0o120777 << 16),
    ]


def _zip(name: str, method: int = zipfile.ZIP_STORED, attributes: int = 0) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        archive.writestr("seq/", "")
        entry = zipfile.ZipInfo(name)
        entry.compress_type, entry.external_attr = method, attributes
        archive.writestr(entry, "1 a\n" * 50)
    return buffer.getvalue()


def _tar_checked(data: bytes, random: Random) -> bytes:
    """Damage in a tar header under a right checksum, and gzip around it."""
    try:
        plain = bytearray(gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data)
    except Exception:  # a seed whose compression is damaged already
        return mutate(data, [data], random)
    blocks = [at_ for at_ in range(0, len(plain) - 511, 512) if plain[at_ + 257 : at_ + 262] == b"ustar"]
    if not blocks:
        return mutate(data, [data], random)
    start = random.choice(blocks)
    block = bytearray(mutate(bytes(plain[start : start + 500]), [], random)[:500].ljust(512, b"\0"))
    if random.random() < 0.3:
        block[124:136] = struct.pack(">BxxxQ", 0x80, random.getrandbits(62))  # a size in base 256
    if random.random() < 0.5:
        block[156:157] = random.choice([b"0", b"L", b"K", b"x", b"g", b"S", b"2", b"5", b"7", b"Z"])
    block[257:265] = plain[start + 257 : start + 265]
    block[148:156] = b" " * 8
    block[148:156] = b"%06o\0 " % sum(block)
    plain[start : start + 512] = block
    return gzip.compress(bytes(plain), 1) if random.random() < 0.5 else bytes(plain)


def _extract(data: bytes | None, folder: Path) -> None:
    target = folder / "out"
    target.mkdir()
    sums = archives.extract(at(folder, "archive.tgz", data or b""), target, lambda progress: None)
    assert all((target / name).resolve().is_relative_to(target.resolve()) for name in sums)
    assert not any(path.is_symlink() for path in target.rglob("*"))


@cache
def _checkpoints() -> list[bytes]:
    network = MaskRCNN(SMALL)
    state = network.state_dict()
    ours = {"format": loading.FORMAT, "config": SMALL.model_dump_json(), "model": state}
    odd = next(iter(state))
    contents: list[Any] = [
        *(ours, {"model": state}, state, {}, [1], {"a": 1}, ours | {"config": "{}"}, ours | {"format": "x"}),
        *(ours | {"model": state | {odd: value}} for value in (torch.zeros(2), torch.zeros(1).expand(10**6, 10**6))),
        *(
            ours | {"model": state | {odd: value}}
            for value in (torch.full_like(state[odd], torch.nan), torch.zeros(2).to_sparse())
        ),
        ours | {"config": SMALL.model_copy(update={"stem": 4096, "channels": 4096}).model_dump_json()},
        *({"model": {**state, "roi_heads.box_predictor.cls_score.weight": torch.zeros(size, 4)}} for size in (91, 7)),
    ]
    stored = [written(lambda file, content=content: torch.save(content, file)) for content in contents]
    stored.append(written(lambda file: torch.save(ours, file, _use_new_zipfile_serialization=False)))
    bomb = io.BytesIO()
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(1 << 20))
    return [*stored, bomb.getvalue()]


def _onnx() -> bytes:
    """A model of one input and one output, written by hand."""

    def field(number: int, body: bytes) -> bytes:
        return bytes([number << 3 | 2, len(body)]) + body

    shape = b"".join(field(1, bytes([1 << 3, size])) for size in (1, 3, 64, 64))
    value = field(1, b"images") + field(2, field(1, bytes([1 << 3, 1]) + field(2, shape)))
    graph = field(5, field(8, b"weight")) + field(11, value) + field(12, value)
    return field(7, graph) + field(14, field(1, b"names") + field(2, b"{0: 'person'}"))


def _read_prepared(data: bytes | None, folder: Path) -> None:
    np.save(folder / "labels.npy", np.zeros((1, 4, 4), np.uint8))
    at(folder, "names.json", b'[["person"]]' if len(data or b"") % 2 == 0 else b"[]")
    at(folder, "images.npy", data)
    PreparedImages(folder, ("person",))


def _read_vocabulary(data: bytes | None, folder: Path) -> None:
    vocabulary._check(vocabulary._unpack(data or b""), folder / "voc.txt")


def _vocabularies() -> list[bytes]:
    node = " ".join(["0", "1", *["7"] * 32, "0.5"])
    texts = (f"10 1 0 0\n{node}\n{node}\n\n", f"10 1 0 0\n{node}\nx\n", f"10 1 0 0\n{node.replace('1', '0', 1)}\n",
             "10 1 0 0\n9" + node[1:], "10 1 0 0\n", "x", "99 1 0 0\n")  # fmt: skip
    return [lzma.compress(text.encode()) for text in texts]


def _repressed(data: bytes, random: Random) -> bytes:
    try:
        return lzma.compress(mutate(lzma.decompress(data), [data], random), preset=0)
    except (lzma.LZMAError, EOFError):
        return mutate(data, [data], random)


IMAGES = _npy(np.zeros((1, 4, 4, 3), np.uint8))
TARGETS = [
    Target("colour image", _read_colour, _colours, mutate_png),
    Target("depth image", _read_depth, _depths, mutate_png),
    Target(
        "recorded mask",
        _read_mask,
        lambda: [
            *_encoded(".png", image=np.eye(12, 16, dtype=np.uint8)),
            *_encoded(".png", image=2 * np.eye(12, 16, dtype=np.uint8)),
            *_encoded(".png", image=np.zeros((12, 16), np.uint8)),
            *_colours(),
        ],
        mutate_png,
    ),
    Target("rendered frame", _read_rendered, _rendered, mutate_png),
    Target("archive", _extract, _archives, _tar_checked),
    Target(
        "checkpoint", lambda data, folder: loading.load_network(at(folder, "net.pt", data)), _checkpoints, mutate_zip
    ),
    Target(
        "ONNX header",
        lambda data, folder: str(onnx.read_header(at(folder, "net.onnx", data))),
        lambda: [_onnx(), b"\x80" * 20],
    ),
    Target("prepared images", _read_prepared, lambda: [IMAGES, IMAGES + b"x"]),
    Target(
        "vocabulary",
        _read_vocabulary,
        _vocabularies,
        _repressed,
        allowed=(vocabulary.TrackerError, lzma.LZMAError, EOFError, ValueError),
    ),
]
