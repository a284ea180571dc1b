"""Random textures, warps of them, and grids of points, shared by the tests of the flow."""

import cv2
import numpy as np


def picture(seed: int = 0, shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    """A uint8 texture with structure at three scales."""
    rng = np.random.default_rng(seed)
    layers = [
        cv2.resize(
            rng.uniform(0, 1, (shape[0] // k, shape[1] // k)),
            shape[::-1],
            interpolation=cv2.INTER_CUBIC,
        )
        for k in (3, 8, 24)
    ]
    return np.clip(sum(layers) * 85, 0, 255).astype(np.uint8)


def moved(
    image: np.ndarray, scale: float = 1.0, degrees: float = 0.0, tx: float = 0.0, ty: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """The image under a similarity around its centre, and the matrix ``[2, 3]``."""
    height, width = image.shape
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), -degrees, scale)
    matrix[:, 2] += tx, ty
    return cv2.warpAffine(image, matrix, (width, height), borderMode=cv2.BORDER_REFLECT), matrix


def moved_points(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    return points @ matrix[:, :2].T + matrix[:, 2]


def grid(shape: tuple[int, int] = (240, 320), margin: int = 60, step: int = 10) -> np.ndarray:
    """float32 points of a regular grid."""
    x = np.arange(margin, shape[1] - margin, step)
    y = np.arange(margin, shape[0] - margin, step)
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2).astype(np.float32)
