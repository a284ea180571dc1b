"""A file of rerun's, from blocks of plain arrays: in the process that has them, or in one of its own.

A block holds rows of entities: for each its ``frames`` (index), ``times`` (seconds since the first frame) and
``values``, and ``lengths`` where a row takes several values, under names like ``error/trans_m|values``. As a program
this module reads blocks from standard input, each an ``.npz`` behind its size in eight bytes: the first is what
`RerunFile` is made of, an empty one is the end.
"""

from __future__ import annotations

import io
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

IMAGE = "world/camera/image"
LAYERS = {"mask": f"{IMAGE}/mask", "kept": f"{IMAGE}/kept", "culled": f"{IMAGE}/culled"}
CLEARED = "cleared:"
"""Stands before the name of an entity that shows nothing from those frames on."""
SIZE_BYTES = 8

Block = dict[str, NDArray[Any]]


class RerunFile:
    """Writes blocks into an ``.rrd`` file; what a program that ends early has handed over stays readable.

    Args:
        start: ``path``, ``name`` (in the viewer), ``matrix`` (of the camera ``[3, 3]``, for images of that size),
            ``size`` (width, height in pixels), and the colours ``kept``, ``culled`` and ``mask``.

    Raises:
        OSError: The file cannot be written.
    """

    def __init__(self, start: Block) -> None:
        import rerun

        self._rr: Any = rerun
        self._width, self._height = map(int, start["size"])
        self._stream = rerun.RecordingStream("dynslam-bench")
        try:
            self._stream.save(str(start["path"]), default_blueprint=_layout())
        except RuntimeError as error:
            raise OSError(str(error)) from error
        self._stream.send_recording_name(str(start["name"]))
        self._set_up(start)

    def _set_up(self, start: Block) -> None:
        rr = self._rr
        pinhole = rr.Pinhole(
            image_from_camera=start["matrix"],
            width=self._width,
            height=self._height,
            camera_xyz=rr.ViewCoordinates.RDF,
        )
        classes = rr.AnnotationContext([(0, "static", (0, 0, 0, 0)), (1, "dynamic", (*start["mask"].tolist(), 110))])
        self._stream.log("world", rr.ViewCoordinates.RDF, static=True)
        self._stream.log(IMAGE, pinhole, classes, static=True)
        for name in ("kept", "culled"):
            looks = rr.Points2D.from_fields(colors=[start[name].tolist()], radii=[1.0])
            self._stream.log(LAYERS[name], looks, static=True)

    def write(self, block: Block) -> None:
        """Add rows, or, under the names ``world/map``, ``world/estimate`` and ``world/truth``, what has no time."""
        rr = self._rr
        for name, values in block.items():
            entity, _, what = name.partition("|")
            if what == "frames":
                times = block[f"{entity}|times"]
                index = [rr.TimeColumn("frame", sequence=values), rr.TimeColumn("time", duration=times)]
                columns = self._columns(entity, block[f"{entity}|values"], block.get(f"{entity}|lengths"))
                self._stream.send_columns(entity.removeprefix(CLEARED), indexes=index, columns=columns)
            elif what == "line":
                colour = block[f"{entity}|colour"].tolist()
                self._stream.log(entity, rr.LineStrips3D([values], colors=[colour]), static=True)
            elif what == "points":
                colours = block.get(f"{entity}|colours")
                self._stream.log(entity, rr.Points3D(values, colors=colours, radii=0.005), static=True)

    def close(self) -> None:
        """End the file."""
        self._stream.disconnect()

    def _columns(self, entity: str, values: NDArray[Any], lengths: NDArray[Any] | None) -> Any:
        rr = self._rr
        if entity.startswith(CLEARED):
            return rr.Clear.columns(is_recursive=values)
        if entity == "world/camera":
            return rr.Transform3D.columns(translation=values[:, :3], quaternion=values[:, 3:])
        if entity == "state":
            return rr.TextLog.columns(text=values.tolist())
        if entity == IMAGE:
            assert lengths is not None
            blobs = [blob.tobytes() for blob in np.split(values, np.cumsum(lengths)[:-1])]
            return rr.EncodedImage.columns(blob=blobs, media_type=["image/jpeg"] * len(blobs))
        if entity == LAYERS["mask"]:
            shape = rr.components.ImageFormat(
                width=self._width, height=self._height, channel_datatype=rr.ChannelDatatype.U8
            )
            buffers = [mask.tobytes() for mask in values]
            return rr.SegmentationImage.columns(buffer=buffers, format=[shape] * len(buffers))
        if entity in LAYERS.values():
            assert lengths is not None
            return rr.Points2D.columns(positions=values.reshape(-1, 2)).partition(lengths.tolist())
        return rr.Scalars.columns(scalars=values)


def _layout() -> Any:
    """What the viewer shows at first: the room on the left, the image and the numbers on the right."""
    import rerun.blueprint as rrb

    numbers = rrb.Horizontal(rrb.TimeSeriesView(origin="error"), rrb.TimeSeriesView(origin="features"))
    right = rrb.Vertical(rrb.Spatial2DView(origin=IMAGE), numbers, row_shares=[2, 1])
    return rrb.Blueprint(rrb.Horizontal(rrb.Spatial3DView(origin="world"), right))


def packed(block: Block) -> bytes:
    """A block as the program reads it."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **block)
    return len(buffer.getvalue()).to_bytes(SIZE_BYTES, "little") + buffer.getvalue()


def _read() -> Block:
    """The next block of standard input; empty at its end."""
    size = int.from_bytes(sys.stdin.buffer.read(SIZE_BYTES), "little")
    with np.load(io.BytesIO(sys.stdin.buffer.read(size) if size else packed({})[SIZE_BYTES:])) as stored:
        return {name: stored[name] for name in stored.files}


def main() -> int:
    """Write what standard input says; on standard output is then what went wrong, or nothing."""
    sys.modules["pandas"] = None  # type: ignore[assignment]
    # Arrow would load it to look whether an array is one of its columns: as long as loading rerun takes.
    try:
        file = RerunFile(_read())
    except OSError as error:
        sys.stdout.write(str(error))
        return 1
    while block := _read():
        file.write(block)
    file.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
