"""The numba kernels of the renderer: ray casting over tile bins, edge antialiasing, flow and motion blur.

Geometry is a list of primitives, each a unit shape in a local frame that is rigid up to a scale per axis (so that a round
cone may have an elliptic section). A ray leaves the camera centre with direction ``((u - cx) / fx, (v - cy) / fy, 1)``;
its parameter t is therefore the z-depth in metres, in the local frame as well. All arithmetic is IEEE float64 without
fastmath, every pixel depends on its own inputs only, and every kernel works on a band of rows: the result is the same for
any number of threads. The kernels release the GIL and start no threads of their own.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

BOX, ROUND_CONE, QUAD = 0, 1, 2
TILE = 16
_NEAR = 0.05
_TWO_PI = 2.0 * math.pi
_jit: Any = njit(cache=True, nogil=True, error_model="numpy")
_inline: Any = njit(cache=True, nogil=True, error_model="numpy", inline="never")


@_inline
def _hit_box(ox, oy, oz, dx, dy, dz, hx, hy, hz, t_max):  # type: ignore[no-untyped-def]
    """Nearest hit of a ray with a box from outside: (t, face), face = 2 * axis + (1 if the positive side)."""
    t_in, t_out, face = -1.0e30, 1.0e30, -1
    if abs(dx) < 1e-12:
        if abs(ox) > hx:
            return 1e30, -1
    else:
        inv = 1.0 / dx
        a, b = (-hx - ox) * inv, (hx - ox) * inv
        side = 0
        if a > b:
            a, b, side = b, a, 1
        if a > t_in:
            t_in, face = a, side
        t_out = min(t_out, b)
    if abs(dy) < 1e-12:
        if abs(oy) > hy:
            return 1e30, -1
    else:
        inv = 1.0 / dy
        a, b = (-hy - oy) * inv, (hy - oy) * inv
        side = 2
        if a > b:
            a, b, side = b, a, 3
        if a > t_in:
            t_in, face = a, side
        t_out = min(t_out, b)
    if abs(dz) < 1e-12:
        if abs(oz) > hz:
            return 1e30, -1
    else:
        inv = 1.0 / dz
        a, b = (-hz - oz) * inv, (hz - oz) * inv
        side = 4
        if a > b:
            a, b, side = b, a, 5
        if a > t_in:
            t_in, face = a, side
        t_out = min(t_out, b)
    if t_in > t_out or t_in < _NEAR or t_in >= t_max:
        return 1e30, -1
    return t_in, face


@_inline
def _hit_round_cone(ox, oy, oz, dx, dy, dz, h, r1, r2, t_max):  # type: ignore[no-untyped-def]
    """Nearest hit with the hull of a sphere r1 at the origin and a sphere r2 at (0, 0, h); h = 0 is a sphere."""
    best = 1e30
    dd = dx * dx + dy * dy + dz * dz
    # Bounding sphere first: most rays of a tile miss.
    cz = oz - 0.5 * h
    rb = 0.5 * h + max(r1, r2)
    b = ox * dx + oy * dy + cz * dz
    if b * b < dd * (ox * ox + oy * oy + cz * cz - rb * rb):
        return best
    if h > 0.0:
        # Tangent cone: sin(alpha) = s = (r1 - r2) / h; its side is x^2 + y^2 = (r1 - s z)^2 / (1 - s^2).
        s = (r1 - r2) / h
        k = 1.0 / (1.0 - s * s)
        w, wd = r1 - s * oz, -s * dz
        a2 = dx * dx + dy * dy - k * wd * wd
        b2 = ox * dx + oy * dy - k * w * wd
        c2 = ox * ox + oy * oy - k * w * w
        disc = b2 * b2 - a2 * c2
        if disc >= 0.0 and abs(a2) > 1e-14:
            t = (-b2 - math.sqrt(disc)) / a2
            z = oz + t * dz
            # The side counts between the two circles of tangency.
            if _NEAR < t and r1 * s <= z <= h + r2 * s and r1 - s * z > 0.0:
                best = t
    b = ox * dx + oy * dy + oz * dz
    disc = b * b - dd * (ox * ox + oy * oy + oz * oz - r1 * r1)
    if disc >= 0.0:
        t = (-b - math.sqrt(disc)) / dd
        if _NEAR < t < best:
            best = t
    if h > 0.0:
        cz = oz - h
        b = ox * dx + oy * dy + cz * dz
        disc = b * b - dd * (ox * ox + oy * oy + cz * cz - r2 * r2)
        if disc >= 0.0:
            t = (-b - math.sqrt(disc)) / dd
            if _NEAR < t < best:
                best = t
    if best >= t_max:
        return 1e30
    return best


@_inline
def _trace(x, y, order, zmin, kind, local, shape):  # type: ignore[no-untyped-def]
    """Nearest primitive along the ray (x, y, 1): (index or -1, face, t)."""
    best_t, best, best_face = 1e30, -1, 0
    for n in range(order.shape[0]):
        p = order[n]
        if zmin[p] >= best_t:
            break
        dx = local[p, 0] * x + local[p, 1] * y + local[p, 2]
        dy = local[p, 4] * x + local[p, 5] * y + local[p, 6]
        dz = local[p, 8] * x + local[p, 9] * y + local[p, 10]
        ox, oy, oz = local[p, 3], local[p, 7], local[p, 11]
        k = kind[p]
        if k == QUAD:
            if dz != 0.0:
                t = -oz / dz
                if _NEAR < t < best_t and abs(ox + t * dx) <= shape[p, 0] and abs(oy + t * dy) <= shape[p, 1]:
                    best_t, best, best_face = t, p, 4
        elif k == BOX:
            t, face = _hit_box(ox, oy, oz, dx, dy, dz, shape[p, 0], shape[p, 1], shape[p, 2], best_t)
            if face >= 0:
                best_t, best, best_face = t, p, face
        else:
            t = _hit_round_cone(ox, oy, oz, dx, dy, dz, shape[p, 0], shape[p, 1], shape[p, 2], best_t)
            if t < best_t:
                best_t, best, best_face = t, p, 0
    return best, best_face, best_t


@_inline
def _texel(atlas, base, log2, u, v, out, weight):  # type: ignore[no-untyped-def]
    """Add the bilinear, wrapped sample of one mip level at (u, v) in [0, 1) units to `out`."""
    size = 1 << log2
    mask = size - 1
    fu, fv = u * size - 0.5, v * size - 0.5
    iu, iv = math.floor(fu), math.floor(fv)
    au, av = fu - iu, fv - iv
    u0, v0 = int(iu) & mask, int(iv) & mask
    u1, v1 = (u0 + 1) & mask, (v0 + 1) & mask
    a, b = base + ((v0 << log2) + u0) * 4, base + ((v0 << log2) + u1) * 4
    c, d = base + ((v1 << log2) + u0) * 4, base + ((v1 << log2) + u1) * 4
    wa, wb = (1.0 - au) * (1.0 - av) * weight, au * (1.0 - av) * weight
    wc, wd = (1.0 - au) * av * weight, au * av * weight
    for ch in range(3):
        out[ch] += wa * atlas[a + ch] + wb * atlas[b + ch] + wc * atlas[c + ch] + wd * atlas[d + ch]


@_inline
def _shade(x, y, p, face, t, focal, kind, local, shape, texture, uv, tint, atlas, level_offset, log2_size, lights,
           out):  # type: ignore[no-untyped-def]  # fmt: skip
    """Colour (0-255 scale) of primitive p hit at depth t along (x, y, 1), into out[0:3]; out[3] = |cos| of incidence."""
    dx = local[p, 0] * x + local[p, 1] * y + local[p, 2]
    dy = local[p, 4] * x + local[p, 5] * y + local[p, 6]
    dz = local[p, 8] * x + local[p, 9] * y + local[p, 10]
    lx, ly, lz = local[p, 3] + t * dx, local[p, 7] + t * dy, local[p, 11] + t * dz
    nx, ny, nz = 0.0, 0.0, 0.0
    u, v = 0.0, 0.0
    k = kind[p]
    if k == ROUND_CONE:
        h, r1, r2 = shape[p, 0], shape[p, 1], shape[p, 2]
        nx, ny = lx, ly
        if h > 0.0:
            s = (r1 - r2) / h
            if lz <= r1 * s:
                nz = lz
            elif lz >= h + r2 * s:
                nz = lz - h
            else:
                nz = s * (r1 - s * lz) / (1.0 - s * s)
        else:
            nz = lz
        u = math.atan2(lx, ly) / _TWO_PI * uv[p, face, 0] + uv[p, face, 2]
        v = -lz * uv[p, face, 1] + uv[p, face, 3]
    else:
        axis = face >> 1
        sign = 1.0 if (face & 1) else -1.0
        if axis == 0:
            nx = sign
            u, v = ly * sign, -lz
        elif axis == 1:
            ny = sign
            u, v = -lx * sign, -lz
        else:
            nz = sign
            u, v = lx, -ly
        u = u * uv[p, face, 0] + uv[p, face, 2]
        v = v * uv[p, face, 1] + uv[p, face, 3]
    # Normal into the camera frame: transpose of the (camera to local) linear part.
    cx = local[p, 0] * nx + local[p, 4] * ny + local[p, 8] * nz
    cy = local[p, 1] * nx + local[p, 5] * ny + local[p, 9] * nz
    cz = local[p, 2] * nx + local[p, 6] * ny + local[p, 10] * nz
    inv = 1.0 / math.sqrt(cx * cx + cy * cy + cz * cz)
    cos = -(cx * x + cy * y + cz) * inv / math.sqrt(x * x + y * y + 1.0)
    if cos < 0.0:
        cos, inv = -cos, -inv
    cx, cy, cz = cx * inv, cy * inv, cz * inv
    # Texel footprint: texels a pixel along the surface, between the isotropic and the slanted one.
    tex = texture[p, face]
    log2 = log2_size[tex]
    if k == ROUND_CONE:
        density = max(
            abs(uv[p, face, 0]) / (_TWO_PI * max(0.5 * (shape[p, 1] + shape[p, 2]), 1e-3)), abs(uv[p, face, 1])
        )
    else:
        density = max(abs(uv[p, face, 0]), abs(uv[p, face, 1]))
    footprint = density * (1 << log2) * t / (focal * math.sqrt(max(cos, 0.05)))
    out[0], out[1], out[2] = 0.0, 0.0, 0.0
    level, blend = 0, 0.0
    top = log2
    while footprint > 2.0 and level < top - 1:
        footprint *= 0.5
        level += 1
    if footprint > 1.0:
        blend = min(footprint - 1.0, 1.0)
    u -= math.floor(u)
    v -= math.floor(v)
    _texel(atlas, level_offset[tex, level], log2 - level, u, v, out, 1.0 - blend)
    if blend > 0.0:
        _texel(atlas, level_offset[tex, level + 1], log2 - level - 1, u, v, out, blend)
    light = lights[0, 3]
    for i in range(1, lights.shape[0]):
        d = cx * lights[i, 0] + cy * lights[i, 1] + cz * lights[i, 2]
        if d > 0.0:
            light += d * lights[i, 3]
    for ch in range(3):
        out[ch] *= tint[p, ch] * light
    out[3] = cos


@_jit
def bin_tiles(order, boxes, tiles_x, tiles_y):  # type: ignore[no-untyped-def]
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


@_jit
def cast_geometry(row0, row1, intrinsics, tiles_x, start, members, zmin, kind, local, shape, hit, depth):  # type: ignore[no-untyped-def]
    """Primitive (``hit`` int32, 8 * index + face, -1 for none) and z-depth (float64) at the pixel centres of rows."""
    fx, fy, cx, cy = intrinsics
    width = hit.shape[1]
    for row in range(row0, row1):
        y = (row - cy) / fy
        for column in range(width):
            tile = (row // TILE) * tiles_x + column // TILE
            x = (column - cx) / fx
            p, face, t = _trace(x, y, members[start[tile] : start[tile + 1]], zmin, kind, local, shape)
            hit[row, column] = 8 * p + face if p >= 0 else -1
            depth[row, column] = t if p >= 0 else 0.0


@_jit
def shade_pixels(row0, row1, intrinsics, tiles_x, start, members, zmin, kind, local, shape, texture, uv, tint, atlas,
                 level_offset, log2_size, lights, hit, depth, jitter, color, cosine):  # type: ignore[no-untyped-def]  # fmt: skip
    """Colour (float32, 0-255 scale) and cosine of incidence of rows; pixels on an edge get `jitter` [S, 2] samples."""
    fx, fy, cx, cy = intrinsics
    height, width = hit.shape
    out = np.zeros(4)
    for row in range(row0, row1):
        y = (row - cy) / fy
        for column in range(width):
            key = hit[row, column]
            x = (column - cx) / fx
            if key < 0:
                color[row, column, 0] = color[row, column, 1] = color[row, column, 2] = 0.0
                cosine[row, column] = 0.0
            else:
                _shade(x, y, key >> 3, key & 7, depth[row, column], fx, kind, local, shape, texture, uv, tint, atlas,
                       level_offset, log2_size, lights, out)  # fmt: skip
                color[row, column, 0], color[row, column, 1], color[row, column, 2] = out[0], out[1], out[2]
                cosine[row, column] = out[3]
            if (
                (column > 0 and hit[row, column - 1] != key)
                or (column + 1 < width and hit[row, column + 1] != key)
                or (row > 0 and hit[row - 1, column] != key)
                or (row + 1 < height and hit[row + 1, column] != key)
            ):
                tile = (row // TILE) * tiles_x + column // TILE
                order = members[start[tile] : start[tile + 1]]
                r, g, b = 0.0, 0.0, 0.0
                for s in range(jitter.shape[0]):
                    xs, ys = (column + jitter[s, 0] - cx) / fx, (row + jitter[s, 1] - cy) / fy
                    p, face, t = _trace(xs, ys, order, zmin, kind, local, shape)
                    if p >= 0:
                        _shade(xs, ys, p, face, t, fx, kind, local, shape, texture, uv, tint, atlas, level_offset,
                               log2_size, lights, out)  # fmt: skip
                        r, g, b = r + out[0], g + out[1], b + out[2]
                scale = 1.0 / jitter.shape[0]
                color[row, column, 0], color[row, column, 1], color[row, column, 2] = r * scale, g * scale, b * scale


@_jit
def flow_field(row0, row1, intrinsics, hit, depth, motion, flow):  # type: ignore[no-untyped-def]
    """Exact optical flow (float32 pixels) of rows.

    ``motion`` [P, 12] takes a point in this camera's frame, fixed to primitive p, to the other camera's frame; where
    nothing is hit or the point leaves the front of the camera, the flow is NaN.
    """
    fx, fy, cx, cy = intrinsics
    width = hit.shape[1]
    for row in range(row0, row1):
        for column in range(width):
            key = hit[row, column]
            if key < 0:
                flow[row, column, 0] = flow[row, column, 1] = np.nan
                continue
            p = key >> 3
            z = depth[row, column]
            x, y = (column - cx) / fx * z, (row - cy) / fy * z
            w = motion[p, 8] * x + motion[p, 9] * y + motion[p, 10] * z + motion[p, 11]
            if w <= _NEAR:
                flow[row, column, 0] = flow[row, column, 1] = np.nan
                continue
            u = motion[p, 0] * x + motion[p, 1] * y + motion[p, 2] * z + motion[p, 3]
            v = motion[p, 4] * x + motion[p, 5] * y + motion[p, 6] * z + motion[p, 7]
            flow[row, column, 0] = u / w * fx + cx - column
            flow[row, column, 1] = v / w * fy + cy - row


@_jit
def motion_blur(row0, row1, color, flow, shutter, blurred):  # type: ignore[no-untyped-def]
    """Average the colour of rows along the pixel's own flow over `shutter` of a frame interval, centred."""
    height, width = color.shape[:2]
    for row in range(row0, row1):
        for column in range(width):
            du, dv = flow[row, column, 0] * shutter, flow[row, column, 1] * shutter
            length = math.sqrt(du * du + dv * dv)
            if not length > 0.75:
                for ch in range(3):
                    blurred[row, column, ch] = color[row, column, ch]
                continue
            taps = min(int(length) + 2, 16)
            r, g, b = 0.0, 0.0, 0.0
            for i in range(taps):
                s = (i + 0.5) / taps - 0.5
                x = min(max(column + s * du, 0.0), width - 1.001)
                y = min(max(row + s * dv, 0.0), height - 1.001)
                x0, y0 = int(x), int(y)
                ax, ay = x - x0, y - y0
                w00, w10, w01, w11 = (1 - ax) * (1 - ay), ax * (1 - ay), (1 - ax) * ay, ax * ay
                r += (
                    w00 * color[y0, x0, 0]
                    + w10 * color[y0, x0 + 1, 0]
                    + w01 * color[y0 + 1, x0, 0]
                    + w11 * color[y0 + 1, x0 + 1, 0]
                )
                g += (
                    w00 * color[y0, x0, 1]
                    + w10 * color[y0, x0 + 1, 1]
                    + w01 * color[y0 + 1, x0, 1]
                    + w11 * color[y0 + 1, x0 + 1, 1]
                )
                b += (
                    w00 * color[y0, x0, 2]
                    + w10 * color[y0, x0 + 1, 2]
                    + w01 * color[y0 + 1, x0, 2]
                    + w11 * color[y0 + 1, x0 + 1, 2]
                )
            blurred[row, column, 0], blurred[row, column, 1], blurred[row, column, 2] = r / taps, g / taps, b / taps
