"""The numba kernels of the renderer: ray casting over tile bins and edge antialiasing.

Geometry is a list of primitives, each a unit shape in a local frame that is rigid up to a scale per axis (so that a
round cone may have an elliptic section). A ray leaves the camera centre with direction
``((u - cx) / fx, (v - cy) / fy, 1)``; its parameter t is therefore the z-depth in metres, in the local frame as well.
All arithmetic is IEEE float64 without fastmath, every pixel depends on its own inputs only, and every kernel works on a
band of rows: the result is the same for any number of threads. The kernels release the GIL and start no threads.
"""

from __future__ import annotations

import math

import numpy as np

from dynslam_bench.core.compiled import dividing_kernel

from ..arithmetic import atan2 as _atan2
from ..scenes.parts import BOX, ROUND_CONE
from .arrays import Intrinsics, Ints, Reals
from .hits import NEAR_M, hit_box, hit_round_cone

TILE = 8
atan2 = dividing_kernel(_atan2)
_PER_TURN = 1.0 / (2.0 * math.pi)


@dividing_kernel
def bin_tiles(order: Ints, boxes: Ints, tiles_x: int, tiles_y: int) -> tuple[Ints, Ints]:
    """Primitive lists of all tiles, nearest bound first.

    Args:
        order: int32 ``[P]`` primitives sorted by their nearest depth; those out of view left out.
        boxes: int32 ``[P_all, 4]`` tile ranges x0, y0, x1, y1 (inclusive) of each primitive.
        tiles_x: Tiles in a row.
        tiles_y: Tiles in a column.

    Returns:
        (start int32 ``[tiles + 1]``, list int32).
    """
    start = np.zeros(tiles_x * tiles_y + 1, np.int32)
    for n in range(order.shape[0]):
        p = order[n]
        for ty in range(boxes[p, 1], boxes[p, 3] + 1):
            for tx in range(boxes[p, 0], boxes[p, 2] + 1):
                start[ty * tiles_x + tx + 1] += 1
    for i in range(tiles_x * tiles_y):
        start[i + 1] += start[i]
    fill = start[:-1].copy()
    members = np.empty(start[-1], np.int32)
    for n in range(order.shape[0]):
        p = order[n]
        for ty in range(boxes[p, 1], boxes[p, 3] + 1):
            for tx in range(boxes[p, 0], boxes[p, 2] + 1):
                tile = ty * tiles_x + tx
                members[fill[tile]] = p
                fill[tile] += 1
    return start, members


# The two kernels below repeat the loop over a tile's primitives: numba counts references of every array that is passed
# to a function that it does not inline, which costs more than the tracing.


@dividing_kernel
def cast_geometry(
    row0: int, row1: int, intrinsics: Intrinsics, tiles_x: int, start: Ints, members: Ints, zmin: Reals, kind: Ints,
    local: Reals, shape: Reals, hit: Ints, depth: Reals,
) -> None:  # fmt: skip
    """Primitive (``hit`` int32, 8 * index + face, -1 for none) and z-depth (float64) at the pixel centres of rows.

    What the neighbouring pixel of the tile saw is tried first, which bounds the search.
    """
    fx, fy, cx, cy = intrinsics
    width = hit.shape[1]
    for row in range(row0, row1):
        y = (row - cy) / fy
        last = -1
        for column in range(width):
            tile = (row // TILE) * tiles_x + column // TILE
            first, end = start[tile], start[tile + 1]
            if column % TILE == 0:
                last = -1
            x = (column - cx) / fx
            t, p, face = 1e30, -1, 0
            for n in range(first - 1 if last >= 0 else first, end):
                q = last
                if n >= first:
                    q = members[n]
                    if zmin[q] >= t:
                        break
                    if q == last:
                        continue
                dx = local[q, 0] * x + local[q, 1] * y + local[q, 2]
                dy = local[q, 4] * x + local[q, 5] * y + local[q, 6]
                dz = local[q, 8] * x + local[q, 9] * y + local[q, 10]
                ox, oy, oz = local[q, 3], local[q, 7], local[q, 11]
                a, b, c = shape[q, 0], shape[q, 1], shape[q, 2]
                if kind[q] == ROUND_CONE:
                    t_hit = hit_round_cone(ox, oy, oz, dx, dy, dz, a, b, c, t)
                    if t_hit < t:
                        t, p, face = t_hit, q, 0
                elif kind[q] == BOX:
                    t_hit, face_hit = hit_box(ox, oy, oz, dx, dy, dz, a, b, c, t)
                    if face_hit >= 0:
                        t, p, face = t_hit, q, face_hit
                else:
                    t_hit = -oz / dz
                    if NEAR_M < t_hit < t and abs(ox + t_hit * dx) <= a and abs(oy + t_hit * dy) <= b:
                        t, p, face = t_hit, q, 4
            last = p
            hit[row, column] = 8 * p + face if p >= 0 else -1
            depth[row, column] = t if p >= 0 else 0.0


@dividing_kernel
def shade_pixels(
    row0: int, row1: int, intrinsics: Intrinsics, tiles_x: int, start: Ints, members: Ints, zmin: Reals, kind: Ints,
    local: Reals, shape: Reals, texture: Ints, uv: Reals, tint: Reals, facets: Reals, atlas: Ints, level_offset: Ints,
    log2_size: Ints, lights: Reals, hit: Ints, depth: Reals, jitter: Reals, color: Reals, cosine: Reals,
) -> None:  # fmt: skip
    """Colour (float32, 0-255 scale) and cosine of incidence of rows.

    ``facets`` [P, 6, 5] holds for each face its unit normal in the camera frame (boxes and quads), its light, and for
    all primitives the texels a pixel at 1 m. Pixels on an edge are the mean of the ``jitter`` [S, 2] samples (offsets
    in pixels); each surface that these meet is shaded once, at the first of its samples.
    """
    fx, fy, cx, cy = intrinsics
    height, width = hit.shape
    samples = jitter.shape[0]
    share = 1.0 / samples
    one, two = np.uint64(1), np.uint64(2)  # unsigned: an index that may be negative costs a test
    for row in range(row0, row1):
        for column in range(width):
            key = hit[row, column]
            edge = (
                (column > 0 and hit[row, column - 1] != key)
                or (column + 1 < width and hit[row, column + 1] != key)
                or (row > 0 and hit[row - 1, column] != key)
                or (row + 1 < height and hit[row + 1, column] != key)
            )
            red, green, blue = 0.0, 0.0, 0.0
            own_red, own_green, own_blue = 0.0, 0.0, 0.0
            new_red, new_green, new_blue = 0.0, 0.0, 0.0
            own_cos, last = 0.0, -2
            centre = key >> 3
            tile = (row // TILE) * tiles_x + column // TILE
            first, end = start[tile], start[tile + 1]
            # Sample -1 is the pixel centre, which the first pass has traced.
            for sample in range(-1, samples if edge else 0):
                x, y = (column - cx) / fx, (row - cy) / fy
                seen, t, p, face = key, depth[row, column], centre, key & 7
                if sample >= 0:
                    x, y = (column + jitter[sample, 0] - cx) / fx, (row + jitter[sample, 1] - cy) / fy
                    t, p, face = 1e30, -1, 0
                    for n in range(first - 1 if centre >= 0 else first, end):
                        q = centre
                        if n >= first:
                            q = members[n]
                            if zmin[q] >= t:
                                break
                            if q == centre:
                                continue
                        dx = local[q, 0] * x + local[q, 1] * y + local[q, 2]
                        dy = local[q, 4] * x + local[q, 5] * y + local[q, 6]
                        dz = local[q, 8] * x + local[q, 9] * y + local[q, 10]
                        ox, oy, oz = local[q, 3], local[q, 7], local[q, 11]
                        a, b, c = shape[q, 0], shape[q, 1], shape[q, 2]
                        if kind[q] == ROUND_CONE:
                            t_hit = hit_round_cone(ox, oy, oz, dx, dy, dz, a, b, c, t)
                            if t_hit < t:
                                t, p, face = t_hit, q, 0
                        elif kind[q] == BOX:
                            t_hit, face_hit = hit_box(ox, oy, oz, dx, dy, dz, a, b, c, t)
                            if face_hit >= 0:
                                t, p, face = t_hit, q, face_hit
                        else:
                            t_hit = -oz / dz
                            if NEAR_M < t_hit < t and abs(ox + t_hit * dx) <= a and abs(oy + t_hit * dy) <= b:
                                t, p, face = t_hit, q, 4
                    seen = 8 * p + face if p >= 0 else -1
                    if seen == key:
                        red, green, blue = red + own_red, green + own_green, blue + own_blue
                        continue
                if seen == last:
                    red, green, blue = red + new_red, green + new_green, blue + new_blue
                    continue
                last = seen
                new_red, new_green, new_blue, cos = 0.0, 0.0, 0.0, 0.0
                if seen >= 0:
                    su, sv = uv[p, face, 0], uv[p, face, 1]
                    u, v = uv[p, face, 2], uv[p, face, 3]
                    lx = local[p, 3] + t * (local[p, 0] * x + local[p, 1] * y + local[p, 2])
                    ly = local[p, 7] + t * (local[p, 4] * x + local[p, 5] * y + local[p, 6])
                    lz = local[p, 11] + t * (local[p, 8] * x + local[p, 9] * y + local[p, 10])
                    norm = math.sqrt(x * x + y * y + 1.0)
                    if kind[p] == ROUND_CONE:
                        h, r1, r2 = shape[p, 0], shape[p, 1], shape[p, 2]
                        nz = lz
                        if h > 0.0:
                            s = (r1 - r2) / h
                            if lz >= h + r2 * s:
                                nz = lz - h
                            elif lz > r1 * s:
                                nz = s * (r1 - s * lz) / (1.0 - s * s)
                        u += atan2(lx, ly) * _PER_TURN * su
                        v -= lz * sv
                        # Normal into the camera frame: transpose of the (camera to local) linear part.
                        nu = local[p, 0] * lx + local[p, 4] * ly + local[p, 8] * nz
                        nv = local[p, 1] * lx + local[p, 5] * ly + local[p, 9] * nz
                        nw = local[p, 2] * lx + local[p, 6] * ly + local[p, 10] * nz
                        inv = 1.0 / math.sqrt(nu * nu + nv * nv + nw * nw)
                        cos = abs(nu * x + nv * y + nw) * inv / norm
                        light = lights[0, 3]
                        for i in range(1, lights.shape[0]):
                            facing = (nu * lights[i, 0] + nv * lights[i, 1] + nw * lights[i, 2]) * inv
                            if facing > 0.0:
                                light += facing * lights[i, 3]
                    else:
                        cos = abs(facets[p, face, 0] * x + facets[p, face, 1] * y + facets[p, face, 2]) / norm
                        light = facets[p, face, 3]
                        if face < 4:
                            side = su if (face & 1) else -su
                            u += ly * side if face < 2 else -lx * side
                            v -= lz * sv
                        else:
                            u += lx * su
                            v -= ly * sv
                    # Texel footprint squared, between those along and across a slanted surface; then two mip levels.
                    tex = texture[p, face]
                    log2 = log2_size[tex]
                    footprint = facets[p, face, 4] * t
                    footprint = footprint * footprint / max(cos, 0.05)
                    level = 0
                    while footprint > 4.0 and level < log2 - 1:
                        footprint *= 0.25
                        level += 1
                    blend = min(max((footprint - 1.0) * (1.0 / 3.0), 0.0), 1.0)
                    u -= math.floor(u)
                    v -= math.floor(v)
                    for upper in range(2 if blend > 0.0 else 1):
                        bits = log2 - level - upper
                        size = 1 << bits
                        base = level_offset[tex, level + upper]
                        fu, fv = u * size + (size - 0.5), v * size + (size - 0.5)  # positive, so that int() floors
                        iu, iv = int(fu), int(fv)
                        au, av = fu - iu, fv - iv
                        u0, v0 = iu & (size - 1), (iv & (size - 1)) << bits
                        u1, v1 = (iu + 1) & (size - 1), ((iv + 1) & (size - 1)) << bits
                        a, b = np.uint64(base + ((v0 + u0) << 2)), np.uint64(base + ((v0 + u1) << 2))
                        c, d = np.uint64(base + ((v1 + u0) << 2)), np.uint64(base + ((v1 + u1) << 2))
                        weight = light * (blend if upper else 1.0 - blend)
                        wa, wb = (1.0 - au) * (1.0 - av) * weight, au * (1.0 - av) * weight
                        wc, wd = (1.0 - au) * av * weight, au * av * weight
                        new_red += wa * atlas[a] + wb * atlas[b] + wc * atlas[c] + wd * atlas[d]
                        new_green += (
                            wa * atlas[a + one] + wb * atlas[b + one] + wc * atlas[c + one] + wd * atlas[d + one]
                        )
                        new_blue += (
                            wa * atlas[a + two] + wb * atlas[b + two] + wc * atlas[c + two] + wd * atlas[d + two]
                        )
                    new_red, new_green, new_blue = new_red * tint[p, 0], new_green * tint[p, 1], new_blue * tint[p, 2]
                if sample < 0:
                    own_red, own_green, own_blue, own_cos = new_red, new_green, new_blue, cos
                else:
                    red, green, blue = red + new_red, green + new_green, blue + new_blue
            if edge:
                red, green, blue = red * share, green * share, blue * share
            else:
                red, green, blue = own_red, own_green, own_blue
            color[row, column, 0], color[row, column, 1], color[row, column, 2] = red, green, blue
            cosine[row, column] = own_cos
