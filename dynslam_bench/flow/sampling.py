"""Bilinear samples of a patch that is rotated and scaled, sixteen at a time.

Each vector instruction has its plain form beside it, which a test compares it with. How an instruction
is written: `core.simd`.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types

from dynslam_bench.core.compiled import kernel
from dynslam_bench.core.simd import (
    FLOAT32X16,
    FLOAT_LANES,
    FLOATS,
    INT32,
    INTS,
    UINT16,
    Bytes,
    Code,
    Definition,
    Floats,
    Ints,
    constant,
    instruction,
    load_vector,
    pointer_to,
    splat,
)


def _grid_places(context: Code, builder: Code, kinds: Code, grid: Code) -> tuple[Code, Code]:
    """Code for columns and rows, in 65536ths of a pixel, of sixteen places of a rotated and scaled grid.

    Args:
        context: Numba's.
        builder: LLVM's.
        kinds: Types of the instruction's arguments, of which the second and third are `columns` and
            `rows`.
        grid: Values of ``columns, rows, at, column, row, step_x, step_y`` as in `sample`.
    """
    columns, rows, at, *origin_and_steps = grid
    right = load_vector(context, builder, kinds[1], columns, at, INTS, 4)
    down = load_vector(context, builder, kinds[2], rows, at, INTS, 4)
    column, row, dx, dy = (splat(builder, INTS, value) for value in origin_and_steps)
    # x = column + right dx - down dy, y = row + right dy + down dx
    x = builder.sub(builder.add(column, builder.mul(right, dx)), builder.mul(down, dy))
    y = builder.add(builder.add(row, builder.mul(right, dy)), builder.mul(down, dx))
    return x, y


@instruction
def store_offsets(
    typing_context: Code,
    offsets: Code,
    columns: Code,
    rows: Code,
    at: Code,
    column: Code,
    row: Code,
    step_x: Code,
    step_y: Code,
    stride: Code,
) -> Definition:
    """Write where in a flat image the pixels lie that are up and left of sixteen places, int32; see `sample`.

    `stride` is the number of pixels a row of the image, int32.
    """

    def generate(context: Code, builder: Code, signature: Code, arguments: Code) -> Code:
        offsets, columns, rows, at, *origin_and_steps, stride = arguments
        grid = [columns, rows, at, *origin_and_steps]
        x, y = _grid_places(context, builder, signature.args, grid)
        # whole pixels of 65536ths
        column = builder.ashr(x, constant(INTS, 16))
        row = builder.ashr(y, constant(INTS, 16))
        offset = builder.add(builder.mul(row, splat(builder, INTS, stride)), column)
        pointer = pointer_to(context, builder, signature.args[0], offsets, at, INTS)
        builder.store(offset, pointer, align=4)
        return context.get_dummy_value()

    return types.void(offsets, columns, rows, types.int64, *([types.int32] * 5)), generate


@kernel
def plain_store_offsets(
    offsets: Ints,
    columns: Ints,
    rows: Ints,
    at: int,
    column: int,
    row: int,
    step_x: int,
    step_y: int,
    stride: int,
) -> None:
    """`store_offsets` place by place."""
    for k in range(at, at + FLOAT_LANES):
        # the place in 65536ths of a pixel, and the pixel that it lies in
        x = column + columns[k] * step_x - rows[k] * step_y
        y = row + columns[k] * step_y + rows[k] * step_x
        offsets[k] = (y >> 16) * stride + (x >> 16)


@instruction
def square(typing_context: Code, image: Code, at: Code, stride: Code) -> Definition:
    """Four pixels of a flat uint8 image as the bytes of an int32: at an index, right of it, and below these two.

    `stride` is the number of pixels a row of the image; `sample` interpolates between the four.
    """

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        image, at, stride = arguments

        def two_pixels(index: Code) -> Code:
            pair = load_vector(context, builder, kind.args[0], image, index, UINT16, 1)
            return builder.zext(pair, INT32)

        above = two_pixels(at)
        below = two_pixels(builder.add(at, stride))
        return builder.or_(above, builder.shl(below, ir.Constant(INT32, 16)))

    return types.int32(image, types.int64, types.int64), generate


@kernel
def plain_square(image: Bytes, at: int, stride: int) -> int:
    """`square` byte by byte, as a number without sign."""
    above = np.int64(image[at]) | np.int64(image[at + 1]) << 8
    below = np.int64(image[at + stride]) | np.int64(image[at + stride + 1]) << 8
    return int(above | below << 16)


@instruction
def sample(
    typing_context: Code,
    squares: Code,
    columns: Code,
    rows: Code,
    at: Code,
    column: Code,
    row: Code,
    step_x: Code,
    step_y: Code,
) -> Definition:
    """Bilinear samples of an image at sixteen places of a rotated and scaled grid.

    Args:
        typing_context: Numba's.
        squares: Flat int32 array, `square` of the image for each place of the grid.
        columns: Flat int32 array, the places' column on the grid ...
        rows: ... and row.
        at: Index of the first of the sixteen in these.
        column: Image column of the grid's origin, in 65536ths of a pixel, int32.
        row: Image row of the grid's origin, likewise.
        step_x: Image columns a grid column (and rows a grid row), likewise.
        step_y: Image rows a grid column (and minus the columns a grid row), likewise.

    Returns:
        Grey levels. The places must lie inside the image by at least one row and one column:
        nothing is checked.
    """

    def generate(context: Code, builder: Code, kind: Code, arguments: Code) -> Code:
        squares, *grid = arguments

        # positions are in 65536ths of a pixel: the lower 16 bits are the part
        def part_of_pixel(position: Code) -> Code:
            part = builder.and_(position, constant(INTS, 65535))
            return builder.fmul(builder.sitofp(part, FLOATS), constant(FLOATS, 1 / 65536))

        def between(first: Code, second: Code, part: Code) -> Code:
            return builder.fadd(first, builder.fmul(part, builder.fsub(second, first)))

        x, y = _grid_places(context, builder, kind.args, grid)
        right = part_of_pixel(x)
        down = part_of_pixel(y)

        # the four bytes of every square: above left, above right, below left, below right
        pixels = load_vector(context, builder, kind.args[0], squares, grid[2], INTS, 4)
        corners = []
        for k in range(4):
            byte = builder.lshr(pixels, constant(INTS, 8 * k))
            corners.append(builder.sitofp(builder.and_(byte, constant(INTS, 255)), FLOATS))

        # along the rows, then between them
        above = between(corners[0], corners[1], right)
        below = between(corners[2], corners[3], right)
        return between(above, below, down)

    return FLOAT32X16(squares, columns, rows, types.int64, *([types.int32] * 4)), generate


@kernel
def plain_sample(
    squares: Ints,
    columns: Ints,
    rows: Ints,
    at: int,
    column: int,
    row: int,
    step_x: int,
    step_y: int,
    out: Floats,
) -> None:
    """`sample` place by place, into `out` ``[16]``."""
    for lane in range(FLOAT_LANES):
        # how far the place lies to the right of the upper left pixel, and below it
        k = at + lane
        x = column + columns[k] * step_x - rows[k] * step_y
        y = row + columns[k] * step_y + rows[k] * step_x
        right = np.float32(x & 65535) * np.float32(1 / 65536)
        down = np.float32(y & 65535) * np.float32(1 / 65536)

        # the four pixels, of which each is a byte
        pixels = np.int64(squares[k])
        above_left = np.float32(pixels & 255)
        above_right = np.float32((pixels >> 8) & 255)
        below_left = np.float32((pixels >> 16) & 255)
        below_right = np.float32((pixels >> 24) & 255)

        # along the rows, then between them
        above = above_left + right * (above_right - above_left)
        below = below_left + right * (below_right - below_left)
        out[lane] = above + down * (below - above)
