"""Network weights: in the package, in the user's cache, or at a published address. Imports no torch."""

from dataclasses import dataclass
from pathlib import Path

from dynslam_bench.core import DownloadError, SegmentationError, weights_folder
from dynslam_bench.core.download import Report, download


@dataclass(frozen=True)
class Checkpoint:
    """A published checkpoint.

    Attributes:
        id: Short name.
        file: Name in the cache.
        url: Address at which it is published.
        sha256_prefix: First digits of its SHA-256, as the publisher gives them in the file name.
        megabytes: Size, for messages.
        license: License of the weights.
        trained_on: Data set.
    """

    id: str
    file: str
    url: str
    sha256_prefix: str
    megabytes: float
    license: str
    trained_on: str


COCO = Checkpoint(
    id="coco",
    file="maskrcnn_resnet50_fpn_coco-bf2d0c1e.pth",
    url="https://download.pytorch.org/models/maskrcnn_resnet50_fpn_coco-bf2d0c1e.pth",
    sha256_prefix="bf2d0c1e",
    megabytes=170,
    license="BSD-3-Clause",
    trained_on="COCO train2017",
)
"""Torchvision's Mask R-CNN, ResNet-50 FPN."""
SELFIE = Checkpoint(
    id="selfie",
    file="selfie_segmentation-8d13b7fa.tflite",
    url="https://cdn.jsdelivr.net/npm/@mediapipe/selfie_segmentation@0.1.1675465747/selfie_segmentation.tflite",
    sha256_prefix="8d13b7fae74af625c641226813616a2117bd6bca19eb3b75574621fc08557f27",
    megabytes=0.25,
    license="Apache-2.0",
    trained_on="Google's pictures of people",
)
"""MediaPipe's selfie segmentation, the file of its npm package: one probability map of people, for indoor scenes."""
CHECKPOINTS = {checkpoint.id: checkpoint for checkpoint in (COCO, SELFIE)}
"""Published checkpoints by id, which is the source of masks that uses them."""


def embedded_weights() -> Path:
    """The file of the network that comes with this package."""
    return Path(__file__).parent / "weights" / "embedded.pt"


def cached_checkpoint(checkpoint: Checkpoint) -> Path | None:
    """The checkpoint's file in the cache, or None."""
    path = weights_folder() / checkpoint.file
    return path if path.is_file() else None


def fetch_checkpoint(checkpoint: Checkpoint, progress: Report | None = None) -> Path:
    """The checkpoint's file, downloaded and verified if it is not in the cache yet.

    A download gets its final name when its checksum is right; an interrupted one is resumed.

    Args:
        checkpoint: What to fetch.
        progress: Called with the progress of the download; see `core.download.download`.

    Raises:
        SegmentationError: No network, no space, or the content's SHA-256 does not begin as
            published; names the address, the size and the path under which the file may be put by
            hand.
    """
    path = weights_folder() / checkpoint.file
    if path.is_file():
        return path
    try:
        download(
            checkpoint.url, path, sha256=checkpoint.sha256_prefix, progress=progress, attempts=3
        )
    except DownloadError as error:
        raise SegmentationError(
            f"cannot fetch the checkpoint '{checkpoint.id}': {error.args[0]}",
            f"put the file of {checkpoint.url} ({checkpoint.megabytes} MB, its SHA-256 begins with "
            f"{checkpoint.sha256_prefix}) at {path}",
        ) from error
    return path
