"""Rotated BRIEF descriptors (Rublee et al., 2011, Section 4): on one image the same bits as OpenCV's ORB."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel

# coordinates of the 256 pairs, a letter each: N is 0, A is -13, Z is 12
_LETTERS = (
    "VKWSRPUBCWFPUBZAPAPZOGOTLDLJAACFAKBEXRYWAFFECUEZUUZTJIKNAPBKENGSZHZMKTLZHAJFYAZFRUSOSKXKQGTZFGHL"
    "LYMDAZFXGQIKJPKUDBHYSBTGSHUMONRIWYYARURZPMRRJBLUFIGDRYWZNFOAALFPKLLQHWJEVZXUNWOQUIYDAHCNXUZOHKHZ"
    "XEZJAVFBANFJQQUVSUXGMUOBQDSTPJQDANASAGBZAQCVGZJUTDZVEMGHLINZBSGSQDVAGGJSKLMGPWSCCAIAMTNMSKSPJAJZ"
    "EHETBDFJXPZKUZZZGAHSJWKRUMZPGTIOAYBSKULHUFZGAGCBOKZZPHQNJQLAMAOWUOVHOMQZWOZTMEMQAADSUUXZZIZWTQUY"
    "SATXPBPQQVRHPTZAWBXQFRGWCZJHOZPFTEUJPQQLTQYNQKVFUVWQCIHJDYIXIFKZDSENVMZHRHTCDZFURLTULNLZIFIPUHXZ"
    "EAFFIAILVFWAECENOFOLUJWOLOMJYHZCBEHRQUUZSSXVNJPVEZIANUPZMPOUSYUEQSTFAJFWIWKKJGKBTSVNGTHZATILODQX"
    "ROVJLLPAPBZZLANHROWQHDKIKAMOUSZCRLSGAWEIUOVTUFUTGJGOFYGFATBFPRQWXIZQHIHUVKWFPBPVCLDQBAGECNDISKYV"
    "LAMZMFNWACBIDLDYKWLAPKQPEAJNJTKDJZLGHCJWTKTYAYISYYZTUIZLMZNUJFKLGOHUABFAGLHFFSHEIMJSAUFXOSSAONXA"
    "WZXMSFXEMYOAEKHPMDOZAOFDVCXHPAQHUAZEDDIGDFFARHVSQZVAJPKKSAXBRASMEWJQNQQEBOHOQPRFDDDWVAZZFBHIPPQU"
    "XTYFTVVBGXHSKEKWMAMSKGKRFLFQRPZZPIQYTEYAQMUZYMZRKNKTRCRZPJPODHFOAUCOAZCATNYANMORAQELEVHKAHFLSEVX"
    "PUQEMHMMWSYLYKZFQNQSMRNXQHRSANDSSVZYVWWHUJVBDRDWUQZRWGXLUNZLMHNC"
)
PATTERN = (np.frombuffer(_LETTERS.encode(), np.uint8).astype(np.float32) - ord("N")).reshape(
    256, 2, 2
)
"""The 256 pairs of places that are compared (learned by Rublee et al.), (column, row) from the keypoint each."""

_GAUSSIAN = cv2.getGaussianKernel(7, 2.0, cv2.CV_32F)
"""Seven weights along one axis, of a Gaussian of 2 pixels."""
_COLUMNS_AND_ROWS = PATTERN.transpose(2, 1, 0).reshape(2, 512).copy()
"""float32 ``[2, 512]``: columns, then rows of all first places, followed by all second places."""
_ONE_BIT_A_BYTE = np.uint64(0x0102040810204080)
"""A word whose bytes are 0 or 1, times this, has them as the bits of its highest byte."""


def smooth(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A uint8 ``[H, W]`` image blurred by a Gaussian (7 x 7, 2 pixels), as BRIEF compares it."""
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_8U, _GAUSSIAN, _GAUSSIAN), dtype=np.uint8)


def rotated_brief(
    smoothed: NDArray[np.uint8], xy: NDArray[np.float32], angle: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Descriptors of keypoints, uint8 ``[N, 32]``: bit k is 1 where the first place of pair k is the darker one.

    Args:
        smoothed: uint8 ``[H, W]``.
        xy: Integer-valued pixels, float32 ``[N, 2]``, at least 19 away from the border.
        angle: Orientations in degrees, float32 ``[N]``.
    """
    return _rotated_brief(smoothed, xy, angle, *_COLUMNS_AND_ROWS)


@kernel
def _rotated_brief(
    smoothed: NDArray[np.uint8],
    xy: NDArray[np.float32],
    angle: NDArray[np.float32],
    px: NDArray[np.float32],
    py: NDArray[np.float32],
) -> NDArray[np.uint8]:
    """`rotated_brief` with the columns and rows of the 512 places, float32 ``[512]`` each.

    Args:
        smoothed: uint8 ``[H, W]``.
        xy: Integer-valued pixels ``[N, 2]``.
        angle: Orientations ``[N]``, degrees.
        px: Columns of the pattern's places from the keypoint, pixels; place k is compared with k +
            256.
        py: Their rows.
    """
    # the image as one row, and scratch arrays for one keypoint
    pixels = smoothed.reshape(-1)
    width = smoothed.shape[1]
    offsets = np.empty(512, np.int32)
    values = np.empty(512, np.uint8)
    darker = np.empty(256, np.uint8)
    words = darker.view(np.uint64)
    out = np.empty((len(xy), 32), np.uint8)
    for i in range(len(xy)):
        # the pattern's places, turned by the keypoint's orientation and rounded
        radians = np.float32(angle[i]) * np.float32(math.pi / 180)
        cosine = np.float32(math.cos(radians))
        sine = np.float32(math.sin(radians))
        for k in range(512):
            column = np.rint(px[k] * cosine - py[k] * sine)
            row = np.rint(px[k] * sine + py[k] * cosine)
            offsets[k] = np.int32(row * np.float32(width) + column)
        # grey levels there; an unsigned index is not tested for being negative
        centre = int(xy[i, 1]) * width + int(xy[i, 0])
        for k in range(512):
            values[k] = pixels[np.uint64(centre + offsets[k])]
        # compare the pairs, and pack eight results into a byte
        for k in range(256):
            darker[k] = values[k] < values[256 + k]
        for k in range(32):
            out[i, k] = (words[k] * _ONE_BIT_A_BYTE) >> np.uint64(56)
    return out
