"""The rendered sequence: frames are rendered when first read, then come from the cache.

The cache is a folder in TUM layout. ``rgb/``, ``depth/`` and ``masks/`` hold one PNG a frame, named
by its stamp; lists name them. Every file appears by an atomic rename and every read checks the
PNG's checksums, so several processes may render into one folder, an interrupted rendering is
resumed, and a damaged file counts as missing.
"""

import struct
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dynslam_bench.contracts import Frame, FrameMasks
from dynslam_bench.core import SequenceError, read_lines, write_atomic
from dynslam_bench.core.module_graph import PLUMBING, module_graph
from dynslam_bench.core.records import digest
from dynslam_bench.geometry import Camera, Trajectory, write_tum
from dynslam_bench.sequences.cameras import write_camera
from dynslam_bench.sequences.synthetic.ids import SyntheticId
from dynslam_bench.sequences.synthetic.renderer import Rendered, Renderer, default_threads
from dynslam_bench.sequences.synthetic.scene import Scene, World, row_times
from dynslam_bench.sequences.synthetic.settings import CAMERA, FPS, RENDERER_VERSION, RenderSettings
from dynslam_bench.sequences.view import Masks

_END = b"\x00\x00\x00\x00IEND\xaeB`\x82"
"""The last chunk of a PNG."""
_MODES = {"masks": ("L",), "depth": ("I;16", "I"), "rgb": ("RGB",)}
"""Kinds of images, in the order in which they are stored, and Pillow's names of their pixel formats."""


# Huffman coding after the SUB filter: as small as level 1 on noisy images, and more than twice as
# fast.
_FAST_PNG = [
    cv2.IMWRITE_PNG_COMPRESSION,
    1,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
]
if hasattr(cv2, "IMWRITE_PNG_FILTER"):
    _FAST_PNG += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]
# masks are of few values, which level 1 packs well
_MASK_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]


def encode_png(image: NDArray[Any]) -> bytes:
    """A PNG of an RGB (uint8, three channels) or single-channel (uint8, uint16) image."""
    stored = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    options = _MASK_PNG if image.ndim == 2 and image.dtype == np.uint8 else _FAST_PNG
    return bytes(cv2.imencode(".png", stored, options)[1].tobytes())


def is_intact_png(data: bytes, size: tuple[int, int], modes: tuple[str, ...]) -> bool:
    """Whether the bytes are a complete PNG whose chunks all carry the right checksum.

    Args:
        data: The file.
        size: Width and height that it has to have.
        modes: Pillow's names of the pixel formats it may have.
    """
    try:
        with Image.open(BytesIO(data), formats=["PNG"]) as image:
            image.verify()
    # Pillow's, if damaged
    except (OSError, SyntaxError, ValueError, struct.error, Image.DecompressionBombError):
        return False
    return data.endswith(_END) and image.size == size and image.mode in modes


class FrameStore:
    """The cache folder of one rendered sequence.

    Args:
        folder: The folder; it need not exist.
        camera: For ``camera.toml`` and the expected image size.
    """

    def __init__(self, folder: Path, camera: Camera) -> None:
        self.folder = folder
        self.camera = camera

    def path(self, kind: str, stamp: float) -> Path:
        """Path of a frame's image of a kind (``rgb``, ``depth``, ``masks``)."""
        return self.folder / kind / f"{stamp:.6f}.png"

    def bytes_of(self, kind: str, stamp: float) -> bytes | None:
        """An image file of the right size and type; None if it is missing or damaged.

        Raises:
            SequenceError: The file exists but cannot be read (permissions, input error).
        """
        path = self.path(kind, stamp)
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            hint = "check the permissions of the cache"
            raise SequenceError(f"cannot read {path}: {error.strerror}", hint) from error
        size = (self.camera.width, self.camera.height)
        return data if is_intact_png(data, size, _MODES[kind]) else None

    def read(self, kind: str, stamp: float) -> NDArray[Any] | None:
        """An image (RGB order), or None if it is missing or damaged; raises as `bytes_of`."""
        data = self.bytes_of(kind, stamp)
        if data is None:
            return None
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if image is not None and kind == "rgb":
            return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        return image

    def write(self, stamp: float, frame: Rendered) -> None:
        """Store a frame; the colour image comes last, so that a frame with one is complete.

        Raises:
            DynslamError: The folder cannot be written.
        """
        images: tuple[NDArray[Any], ...] = (frame.instances, frame.raw_depth, frame.rgb)
        for kind, image in zip(_MODES, images, strict=True):
            write_atomic(self.path(kind, stamp), encode_png(image))

    def write_lists(self, truth: Trajectory) -> None:
        """Write ``rgb.txt``, ``depth.txt`` and ``masks.txt`` of the frames there are, the poses and the camera.

        The poses are those of `truth`, or those already listed where these are more.
        """
        # the lists of the images that are there
        for kind in _MODES:
            lines = [f"# {kind} images of a rendered sequence", "# timestamp filename", "#"]
            stamps = sorted((path.stem for path in (self.folder / kind).glob("*.png")), key=float)
            lines += [f"{stamp} {kind}/{stamp}.png" for stamp in stamps]
            write_atomic(self.folder / f"{kind}.txt", "\n".join(lines) + "\n")

        # the poses, where fewer are listed: lines beside those of two comments
        poses = self.folder / "groundtruth.txt"
        listed_lines = 0
        if poses.is_file():
            listed_lines = sum(1 for _ in read_lines(poses, kind=SequenceError))
        if listed_lines < len(truth) + 2:
            write_tum(poses, truth, comment="exact poses of a rendered sequence")
        write_camera(self.folder / "camera.toml", self.camera, fps=FPS)


_RENDERER = "dynslam_bench.sequences.synthetic.renderer"
"""The module whose import closure decides which stored frames are those of this code."""
START_S = 1000.0
"""Stamp of the first frame in seconds."""


class SyntheticSequence:
    """A rendered sequence; fulfils the `Sequence` protocol.

    Args:
        sequence: Which sequence.
        cache_root: Folder under which rendered frames are kept; None keeps nothing and renders
            every time.
        settings: What differs from the default rendering.
        threads: Threads a frame; None for the cores there are, at most four. The frames do not
            depend on it.

    Attributes:
        id: For example ``synthetic/walking_xyz?scene=0&frames=600``.
        whole_id: The id without its length, for example ``synthetic/walking_xyz?scene=0``: all
            lengths cut the same script.
        split: ``tune`` (scenes 0-99) or ``held-out`` (all others).
        tags: How much of the scene moves.
        noise: Seed of the sensors' noise; None for the scene's own.
        timestamps: Stamps of all frames in seconds.
        store: The cache of its frames; None without one.
    """

    def __init__(
        self,
        sequence: SyntheticId,
        cache_root: Path | None,
        settings: RenderSettings,
        threads: int | None = None,
    ) -> None:
        # which sequence
        self._id = sequence
        self._cache_root = cache_root
        self.threads = threads or default_threads()
        self.settings = settings
        self.id = str(sequence)
        self.whole_id = sequence.whole
        self.split = sequence.split
        self.noise = sequence.noise
        self.tags = frozenset({sequence.variant.tag if settings.people == "moving" else "static"})

        # what every sequence says of itself
        self.fps = FPS
        self.license = "CC0-1.0"
        self.citation = (
            f"dynslam-bench rendered sequence {self.id}, renderer version {RENDERER_VERSION}"
        )
        self.timestamps = np.round(START_S + np.arange(sequence.frames) / FPS, 6)

        # the folder of its frames; stored frames are those of this code: an edited renderer renders again
        noise = "" if sequence.noise is None else f"-noise{sequence.noise}"
        rendered_by = digest([self._key(), module_graph().digest([_RENDERER], PLUMBING)], 8)
        # no "?": Windows has none in names
        label = f"{sequence.name}@{sequence.scene}{noise}-{rendered_by}"
        self.store: FrameStore | None = None
        if cache_root is not None:
            self.store = FrameStore(Path(cache_root) / "synthetic" / label, CAMERA)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._id, self._cache_root, self.settings, self.threads)

    @property
    def camera(self) -> Camera:
        """The camera of TUM's fr3 sequences, without distortion; the fast sequences' has a rolling shutter."""
        return replace(CAMERA, readout_s=self.world.optics.readout_s)

    @cached_property
    def ground_truth(self) -> Trajectory:
        """Exact camera-to-world poses of all frames; needs no rendering."""
        return Trajectory(self.timestamps, self.world.camera(np.arange(len(self)) / FPS))

    @property
    def masks(self) -> Masks:
        """Exact masks of the instances, by frame index."""
        return Masks(self._masks_of)

    def _masks_of(self, index: int) -> FrameMasks:
        """The exact masks of a frame: from the cache, else rendered without colours."""
        i = range(len(self))[index]
        ids = None if self.store is None else self.store.read("masks", float(self.timestamps[i]))
        if ids is None:
            ids = self.renderer.geometry(i)[1]
        return FrameMasks(ids, self.scene.world.class_names, self.scene.moving(i))

    @cached_property
    def world(self) -> World:
        """The room, its bodies and people, and the camera's path."""
        return self._id.variant.build(self._id.scene)

    @cached_property
    def scene(self) -> Scene:
        """The geometry behind the frames."""
        return Scene(self.world, self._id.scene, self.settings)

    @cached_property
    def renderer(self) -> Renderer:
        """The renderer; built when the first frame is rendered."""
        return Renderer(self._id, self.scene, self.settings, self.threads)

    def digest(self) -> str:
        """Short digest of the renderer's version and all parameters."""
        return digest({"id": self.id, "key": self._key()})

    def scene_digest(self) -> str:
        """Digest of what is filmed: neither the length nor the sensors' noise."""
        return digest({"scene": f"{self._id.name}@{self._id.scene}", "key": self._key()})

    def _key(self) -> str:
        """Short digest of what decides the pixels beside the scene and the length."""
        family = {"family": self._id.variant.version} if self._id.variant.version else {}
        return digest(
            {"version": RENDERER_VERSION, "settings": self.settings.model_dump(mode="json")}
            | family,
            8,
        )

    def __len__(self) -> int:
        return self._id.frames

    def __getitem__(self, index: int) -> Frame:
        i = range(len(self))[index]
        stamp = float(self.timestamps[i])

        # from the cache
        if self.store is not None:
            rgb = self.store.read("rgb", stamp)
            raw = self.store.read("depth", stamp)
            if rgb is not None and raw is not None:
                return Frame(i, stamp, rgb, _metres(raw))

        # rendered and stored; the lists are renewed at the first and the last frame
        made = self._make(i, self.renderer)
        if self.store is not None and i in (0, len(self) - 1):
            self.store.write_lists(self.ground_truth)
        return Frame(i, stamp, made.rgb, _metres(made.raw_depth))

    def flow(self, index: int, other: int | None = None) -> NDArray[np.float32]:
        """Exact optical flow float32 ``[H, W, 2]`` in pixels (u, v) from a frame to another (default: the next).

        It is the motion of the surface point at each pixel centre, also where that point is hidden
        in the other frame; NaN where it comes to lie behind the camera. Recomputed from the
        geometry, nothing is stored.
        """
        i = range(len(self))[index]
        return self.renderer.flow(i, i + 1 if other is None else range(len(self))[other])

    def row_poses(self, index: int) -> NDArray[np.float64]:
        """Exact camera-to-world poses ``[H, 4, 4]`` of all rows of a frame; all the same under a global shutter.

        The frame's own pose (`ground_truth`) is that of the middle of the image.
        """
        return self.scene.world.camera(
            row_times(range(len(self))[index], self.scene.world.optics.readout_s)
        )

    def exact_depth(self, index: int) -> NDArray[np.float64]:
        """Exact z-depth float64 ``[H, W]`` in metres at the pixel centres, 0 where nothing is hit."""
        return self.renderer.geometry(range(len(self))[index])[0]

    def render(self, progress: Callable[[int, int], None] | None = None) -> int:
        """Render every frame that is missing or damaged; several frames at a time.

        Args:
            progress: Called with (frames done, frames in all) after each frame.

        Returns:
            How many frames had to be rendered.

        Raises:
            DynslamError: The cache cannot be written; frames already rendered stay.
        """
        # what is missing or damaged
        store = self.store
        total = len(self)
        todo = [i for i in range(total) if store is None or not self._is_stored(store, i)]
        report = progress or (lambda done, total: None)
        report(total - len(todo), total)

        # one thread a frame
        if todo:
            renderer = Renderer(self._id, self.scene, self.settings, threads=1)
            # the textures are drawn once, before several threads ask for them
            _ = self.scene.atlas
            with ThreadPoolExecutor(self.threads) as pool:
                frames = pool.map(lambda index: self._make(index, renderer) and None, todo)
                for done, _ in enumerate(frames, total - len(todo) + 1):
                    report(done, total)
        if store is not None:
            store.write_lists(self.ground_truth)
        return len(todo)

    def _is_stored(self, store: FrameStore, index: int) -> bool:
        """Whether all images of a frame are there and intact."""
        return all(
            store.bytes_of(kind, float(self.timestamps[index])) is not None for kind in _MODES
        )

    def _make(self, index: int, renderer: Renderer) -> Rendered:
        """Render a frame and store it."""
        made = renderer.render(index)
        if self.store is not None:
            self.store.write(float(self.timestamps[index]), made)
        return made


def _metres(raw: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Depth in metres ``[H, W]`` of a stored depth image, 0 missing."""
    return raw.astype(np.float32) / np.float32(CAMERA.written_depth_factor)
