"""The renderer's numba kernels: intersections of rays, tiles, antialiased shading, flow, motion blur, two sensors."""

import math

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import Scalar, dividing_kernel
from dynslam_bench.sequences.synthetic.arithmetic import atan2 as _atan2
from dynslam_bench.sequences.synthetic.parts import BOX, ROUND_CONE

Ints = NDArray[np.integer]
Reals = NDArray[np.floating]
Intrinsics = tuple[float, float, float, float]
"""Focal lengths and principal point, pixels."""


# Intersections of rays with primitives.

NEAR_M = 0.05
"""Nothing nearer than this is seen, metres."""


@dividing_kernel
def hit_box(
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    hx: float,
    hy: float,
    hz: float,
    t_max: float,
) -> tuple[float, int]:
    """Nearest hit of a ray with a box from outside: (t, face), face = 2 * axis + (1 if the positive side)."""
    t_in = -1.0e30
    t_out = 1.0e30
    face = -1
    origin = (ox, oy, oz)
    direction = (dx, dy, dz)
    half = (hx, hy, hz)
    for axis in range(3):
        o = origin[axis]
        d = direction[axis]
        h = half[axis]
        if abs(d) < 1e-12:
            if abs(o) > h:
                return 1e30, -1
        else:
            inv = 1.0 / d
            a = (-h - o) * inv
            b = (h - o) * inv
            side = 2 * axis
            if a > b:
                a, b, side = b, a, side + 1
            if a > t_in:
                t_in = a
                face = side
            t_out = min(t_out, b)
    if t_in > t_out or t_in < NEAR_M or t_in >= t_max:
        return 1e30, -1
    return t_in, face


@dividing_kernel
def hit_sphere(
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    dd: float,
    r: float,
    best: float,
) -> float:
    """Nearest hit with a sphere about the origin if it is before `best`, else that; dd is the direction's square."""
    b = ox * dx + oy * dy + oz * dz
    disc = b * b - dd * (ox * ox + oy * oy + oz * oz - r * r)
    if disc < 0.0:
        return best
    t = (-b - math.sqrt(disc)) / dd
    return t if NEAR_M < t < best else best


@dividing_kernel
def hit_round_cone(
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    h: float,
    r1: float,
    r2: float,
    t_max: float,
) -> float:
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
        # Tangent cone: sin(alpha) = s = (r1 - r2) / h; its side is x^2 + y^2 = (r1 - s z)^2 / (1 -
        # s^2).
        s = (r1 - r2) / h
        k = 1.0 / (1.0 - s * s)
        w = r1 - s * oz
        wd = -s * dz
        a2 = dx * dx + dy * dy - k * wd * wd
        b2 = ox * dx + oy * dy - k * w * wd
        c2 = ox * ox + oy * oy - k * w * w
        disc = b2 * b2 - a2 * c2
        if disc >= 0.0 and abs(a2) > 1e-14:
            t = (-b2 - math.sqrt(disc)) / a2
            z = oz + t * dz
            # The side counts between the two circles of tangency.
            if NEAR_M < t and r1 * s <= z <= h + r2 * s and r1 - s * z > 0.0:
                best = t
    best = hit_sphere(ox, oy, oz, dx, dy, dz, dd, r1, best)
    if h > 0.0:
        best = hit_sphere(ox, oy, oz - h, dx, dy, dz, dd, r2, best)
    return 1e30 if best >= t_max else best


# Ray casting over tiles, and antialiasing of edges.


@dividing_kernel
def hit_primitive(
    kind: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, a: float, b: float, c: float,
    t_max: float,
) -> tuple[float, int]:  # fmt: skip
    """Nearest hit of a ray with a primitive before `t_max`: (t, face); face is -1 without one."""
    if kind == ROUND_CONE:
        t = hit_round_cone(ox, oy, oz, dx, dy, dz, a, b, c, t_max)
        return t, 0 if t < t_max else -1
    if kind == BOX:
        return hit_box(ox, oy, oz, dx, dy, dz, a, b, c, t_max)
    t = -oz / dz
    return t, 4 if NEAR_M < t < t_max and abs(ox + t * dx) <= a and abs(oy + t * dy) <= b else -1


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
    start = np.cumsum(start).astype(np.int32)
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


# The two kernels below repeat the loop over a tile's primitives. As a function of its own, inlined
# or not, it makes the first one take 35 ms a frame in place of 15: numba counts references of every
# array that is passed to it.


@dividing_kernel
def cast_geometry(
    row0: int, row1: int, intrinsics: Intrinsics, tiles_x: int, start: Ints, members: Ints, zmin: Reals, kind: Ints,
    local: Reals, shape: Reals, hit: Ints, depth: Reals,
) -> None:  # fmt: skip
    """Primitive (``hit`` int32, 8 * index + face, -1 for none) and z-depth (float64) at the pixel centres of rows.

    ``local`` [R, P, 12] maps the camera to the primitives' frames: one for all rows, or one for
    each row of the image. What the neighbouring pixel of the tile saw is tried first.
    """
    fx, fy, cx, cy = intrinsics
    width = hit.shape[1]
    for row in range(row0, row1):
        maps = local[row % len(local)]
        y = (row - cy) / fy
        last = -1
        for column in range(width):
            tile = (row // TILE) * tiles_x + column // TILE
            first = start[tile]
            end = start[tile + 1]
            if column % TILE == 0:
                last = -1
            x = (column - cx) / fx
            t = 1e30
            p = -1
            face = 0
            for n in range(first - 1 if last >= 0 else first, end):
                q = last
                if n >= first:
                    q = members[n]
                    if zmin[q] >= t:
                        break
                    if q == last:
                        continue
                dx = maps[q, 0] * x + maps[q, 1] * y + maps[q, 2]
                dy = maps[q, 4] * x + maps[q, 5] * y + maps[q, 6]
                dz = maps[q, 8] * x + maps[q, 9] * y + maps[q, 10]
                ox = maps[q, 3]
                oy = maps[q, 7]
                oz = maps[q, 11]
                a = shape[q, 0]
                b = shape[q, 1]
                c = shape[q, 2]
                t_hit, face_hit = hit_primitive(kind[q], ox, oy, oz, dx, dy, dz, a, b, c, t)
                if face_hit >= 0:
                    t = t_hit
                    p = q
                    face = face_hit
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

    ``facets`` [P, 6, 5] holds for each face its unit normal in the camera frame (boxes and quads),
    its light, and for all primitives the texels a pixel at 1 m. Pixels on an edge are the mean of
    the ``jitter`` [S, 2] samples (offsets in pixels); each surface that these meet is shaded once,
    at the first of its samples.
    """
    fx, fy, cx, cy = intrinsics
    height, width = hit.shape
    samples = jitter.shape[0]
    share = 1.0 / samples
    # unsigned: an index that may be negative costs a test
    one = np.uint64(1)
    two = np.uint64(2)
    for row in range(row0, row1):
        maps = local[row % len(local)]
        for column in range(width):
            key = hit[row, column]
            edge = (
                (column > 0 and hit[row, column - 1] != key)
                or (column + 1 < width and hit[row, column + 1] != key)
                or (row > 0 and hit[row - 1, column] != key)
                or (row + 1 < height and hit[row + 1, column] != key)
            )
            red = 0.0
            green = 0.0
            blue = 0.0
            own_red = 0.0
            own_green = 0.0
            own_blue = 0.0
            new_red = 0.0
            new_green = 0.0
            new_blue = 0.0
            own_cos = 0.0
            last = -2
            centre = key >> 3
            tile = (row // TILE) * tiles_x + column // TILE
            first = start[tile]
            end = start[tile + 1]
            # Sample -1 is the pixel centre, which the first pass has traced.
            for sample in range(-1, samples if edge else 0):
                x = (column - cx) / fx
                y = (row - cy) / fy
                surface = key
                t = depth[row, column]
                p = centre
                face = key & 7
                if sample >= 0:
                    x = (column + jitter[sample, 0] - cx) / fx
                    y = (row + jitter[sample, 1] - cy) / fy
                    t = 1e30
                    p = -1
                    face = 0
                    for n in range(first - 1 if centre >= 0 else first, end):
                        q = centre
                        if n >= first:
                            q = members[n]
                            if zmin[q] >= t:
                                break
                            if q == centre:
                                continue
                        dx = maps[q, 0] * x + maps[q, 1] * y + maps[q, 2]
                        dy = maps[q, 4] * x + maps[q, 5] * y + maps[q, 6]
                        dz = maps[q, 8] * x + maps[q, 9] * y + maps[q, 10]
                        ox = maps[q, 3]
                        oy = maps[q, 7]
                        oz = maps[q, 11]
                        a = shape[q, 0]
                        b = shape[q, 1]
                        c = shape[q, 2]
                        t_hit, face_hit = hit_primitive(kind[q], ox, oy, oz, dx, dy, dz, a, b, c, t)
                        if face_hit >= 0:
                            t = t_hit
                            p = q
                            face = face_hit
                    surface = 8 * p + face if p >= 0 else -1
                    if surface == key:
                        red = red + own_red
                        green = green + own_green
                        blue = blue + own_blue
                        continue
                if surface == last:
                    red = red + new_red
                    green = green + new_green
                    blue = blue + new_blue
                    continue
                last = surface
                new_red = 0.0
                new_green = 0.0
                new_blue = 0.0
                cos = 0.0
                if surface >= 0:
                    su = uv[p, face, 0]
                    sv = uv[p, face, 1]
                    u = uv[p, face, 2]
                    v = uv[p, face, 3]
                    lx = maps[p, 3] + t * (maps[p, 0] * x + maps[p, 1] * y + maps[p, 2])
                    ly = maps[p, 7] + t * (maps[p, 4] * x + maps[p, 5] * y + maps[p, 6])
                    lz = maps[p, 11] + t * (maps[p, 8] * x + maps[p, 9] * y + maps[p, 10])
                    norm = math.sqrt(x * x + y * y + 1.0)
                    if kind[p] == ROUND_CONE:
                        h = shape[p, 0]
                        r1 = shape[p, 1]
                        r2 = shape[p, 2]
                        nz = lz
                        if h > 0.0:
                            s = (r1 - r2) / h
                            if lz >= h + r2 * s:
                                nz = lz - h
                            elif lz > r1 * s:
                                nz = s * (r1 - s * lz) / (1.0 - s * s)
                        u += atan2(lx, ly) * _PER_TURN * su
                        v -= lz * sv
                        # Normal into the camera frame: transpose of the (camera to local) linear
                        # part.
                        nu = maps[p, 0] * lx + maps[p, 4] * ly + maps[p, 8] * nz
                        nv = maps[p, 1] * lx + maps[p, 5] * ly + maps[p, 9] * nz
                        nw = maps[p, 2] * lx + maps[p, 6] * ly + maps[p, 10] * nz
                        inv = 1.0 / math.sqrt(nu * nu + nv * nv + nw * nw)
                        cos = abs(nu * x + nv * y + nw) * inv / norm
                        light = lights[0, 3]
                        for i in range(1, lights.shape[0]):
                            facing = (
                                nu * lights[i, 0] + nv * lights[i, 1] + nw * lights[i, 2]
                            ) * inv
                            if facing > 0.0:
                                light += facing * lights[i, 3]
                    else:
                        cos = (
                            abs(
                                facets[p, face, 0] * x + facets[p, face, 1] * y + facets[p, face, 2]
                            )
                            / norm
                        )
                        light = facets[p, face, 3]
                        if face < 4:
                            side = su if (face & 1) else -su
                            u += ly * side if face < 2 else -lx * side
                            v -= lz * sv
                        else:
                            u += lx * su
                            v -= ly * sv
                    # Texel footprint squared, between those along and across a slanted surface;
                    # then two mip levels.
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
                        # positive, so that int() floors
                        fu = u * size + (size - 0.5)
                        fv = v * size + (size - 0.5)
                        iu = int(fu)
                        iv = int(fv)
                        au = fu - iu
                        av = fv - iv
                        u0 = iu & (size - 1)
                        v0 = (iv & (size - 1)) << bits
                        u1 = (iu + 1) & (size - 1)
                        v1 = ((iv + 1) & (size - 1)) << bits
                        a = np.uint64(base + ((v0 + u0) << 2))
                        b = np.uint64(base + ((v0 + u1) << 2))
                        c = np.uint64(base + ((v1 + u0) << 2))
                        d = np.uint64(base + ((v1 + u1) << 2))
                        weight = light * (blend if upper else 1.0 - blend)
                        wa = (1.0 - au) * (1.0 - av) * weight
                        wb = au * (1.0 - av) * weight
                        wc = (1.0 - au) * av * weight
                        wd = au * av * weight
                        new_red += wa * atlas[a] + wb * atlas[b] + wc * atlas[c] + wd * atlas[d]
                        new_green += (
                            wa * atlas[a + one]
                            + wb * atlas[b + one]
                            + wc * atlas[c + one]
                            + wd * atlas[d + one]
                        )
                        new_blue += (
                            wa * atlas[a + two]
                            + wb * atlas[b + two]
                            + wc * atlas[c + two]
                            + wd * atlas[d + two]
                        )
                    new_red = new_red * tint[p, 0]
                    new_green = new_green * tint[p, 1]
                    new_blue = new_blue * tint[p, 2]
                if sample < 0:
                    own_red = new_red
                    own_green = new_green
                    own_blue = new_blue
                    own_cos = cos
                else:
                    red = red + new_red
                    green = green + new_green
                    blue = blue + new_blue
            if edge:
                red = red * share
                green = green * share
                blue = blue * share
            else:
                red = own_red
                green = own_green
                blue = own_blue
            color[row, column, 0] = red
            color[row, column, 1] = green
            color[row, column, 2] = blue
            cosine[row, column] = own_cos


# Motion in the image: exact flow, and blur along it. Rows are independent.

MOST_TAPS = 16
"""Samples of the longest blur."""


def tap_shares() -> Reals:
    """Where along a blur each of its taps lies, as shares of its length from the middle: ``[n, i]`` for tap i of n."""
    taps = np.arange(MOST_TAPS + 1)[:, None]
    i = np.arange(MOST_TAPS)[None]
    return np.where(i < taps, (i + 0.5) / np.maximum(taps, 1) - 0.5, 0.0)


@dividing_kernel
def flow_field(
    row0: int,
    row1: int,
    intrinsics: Intrinsics,
    hit: Ints,
    depth: Reals,
    motion: Reals,
    flow: Reals,
) -> None:
    """Exact optical flow (float32 pixels) of rows.

    ``motion`` [P, 12] takes a point in this camera's frame, fixed to primitive p, to the other
    camera's frame. Where nothing is hit or the point leaves the front of the camera, the flow is
    NaN.
    """
    fx, fy, cx, cy = intrinsics
    width = hit.shape[1]
    for row in range(row0, row1):
        for column in range(width):
            flow[row, column, 0] = flow[row, column, 1] = np.nan
            p = hit[row, column] >> 3
            z = depth[row, column]
            x = (column - cx) / fx * z
            y = (row - cy) / fy * z
            w = motion[p, 8] * x + motion[p, 9] * y + motion[p, 10] * z + motion[p, 11]
            if p >= 0 and w > NEAR_M:
                u = motion[p, 0] * x + motion[p, 1] * y + motion[p, 2] * z + motion[p, 3]
                v = motion[p, 4] * x + motion[p, 5] * y + motion[p, 6] * z + motion[p, 7]
                flow[row, column, 0] = u / w * fx + cx - column
                flow[row, column, 1] = v / w * fy + cy - row


@dividing_kernel
def motion_blur(
    row0: int,
    row1: int,
    color: Reals,
    exact: Reals,
    shares: Reals,
    flow: Reals,
    shutter: float,
    blurred: Reals,
) -> None:
    """Average the colour of rows along the pixel's own flow over `shutter` of a frame interval, centred.

    ``exact`` is the whole colour image as flat float64: what all taps read is converted once.
    ``shares`` are `tap_shares`. Unsigned indices need no test for negative ones.
    """
    height, width = color.shape[:2]
    right = width - 1.001
    below = height - 1.001
    stride = np.uint64(3 * width)
    one = np.uint64(1)
    two = np.uint64(2)
    three = np.uint64(3)
    four = np.uint64(4)
    five = np.uint64(5)
    for row in range(row0, row1):
        for column in range(width):
            du = flow[row, column, 0] * shutter
            dv = flow[row, column, 1] * shutter
            length = math.sqrt(du * du + dv * dv)
            if not length > 0.75:
                for ch in range(3):
                    blurred[row, column, ch] = color[row, column, ch]
                continue
            taps = min(int(length) + 2, MOST_TAPS)
            r = 0.0
            g = 0.0
            b = 0.0
            for i in range(taps):
                s = shares[taps, i]
                x = min(max(column + s * du, 0.0), right)
                y = min(max(row + s * dv, 0.0), below)
                x0 = np.uint32(x)
                y0 = np.uint32(y)
                ax = x - x0
                ay = y - y0
                w00 = (1 - ax) * (1 - ay)
                w10 = ax * (1 - ay)
                w01 = (1 - ax) * ay
                w11 = ax * ay
                k = np.uint64(y0) * stride + three * np.uint64(x0)
                m = k + stride
                r += (
                    w00 * exact[k]
                    + w10 * exact[k + three]
                    + w01 * exact[m]
                    + w11 * exact[m + three]
                )
                g += (
                    w00 * exact[k + one]
                    + w10 * exact[k + four]
                    + w01 * exact[m + one]
                    + w11 * exact[m + four]
                )
                b += (
                    w00 * exact[k + two]
                    + w10 * exact[k + five]
                    + w01 * exact[m + two]
                    + w11 * exact[m + five]
                )
            blurred[row, column, 0] = r / taps
            blurred[row, column, 1] = g / taps
            blurred[row, column, 2] = b / taps


# The two sensors: a structured-light depth camera and a colour camera with a rolling readout.
#
# Noise is a function of (seed, frame, pixel) through an integer hash, so that it depends neither on
# the order of rendering nor on the number of threads.
#
# Depth model, in the order of the physics of a Kinect-like sensor:
#
# 1. The projector stands one baseline beside the camera; what it cannot see is in its shadow and
# has no depth. 2. The disparity fx * baseline / z carries noise and is quantised to 1/8 pixel: the
# depth steps grow with z^2. 3. Correlation fails near depth edges, on dark surfaces far away, on
# slanted surfaces, and outside the range.


@dividing_kernel
def _hash(a: Scalar, b: Scalar) -> Scalar:
    """A 64-bit hash (splitmix64 finaliser) of two 64-bit integers."""
    z = np.uint64(a) + np.uint64(0x9E3779B97F4A7C15) * (np.uint64(b) + np.uint64(1))
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@dividing_kernel
def _normal(h: Scalar) -> float:
    """About normal with variance 1: the centred sum of the four 16-bit parts of a hash."""
    m = np.uint64(0xFFFF)
    total = (
        float(h & m)
        + float((h >> np.uint64(16)) & m)
        + float((h >> np.uint64(32)) & m)
        + float(h >> np.uint64(48))
    )
    return (total - 131070.0) * (1.7320508075688772 / 65536.0)


@dividing_kernel
def _uniform(h: Scalar) -> float:
    return float(h >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@dividing_kernel
def _depths_around(depth: Reals, row: int, u: int, reach: int) -> tuple[float, float]:
    """The least and the greatest depth of a pixel and of those `reach` away on either side, above and below."""
    height, width = depth.shape
    lowest = depth[row, u]
    highest = depth[row, u]
    for down, right in ((0, -reach), (0, reach), (-reach, 0), (reach, 0)):
        v2 = row + down
        u2 = u + right
        if 0 <= v2 < height and 0 <= u2 < width:
            other = depth[v2, u2]
            if other > 0.0:
                lowest = min(lowest, other)
                highest = max(highest, other)
    return lowest, highest


@dividing_kernel
def measure_depth(
    row0: int, row1: int, seed: Scalar, fx: float, baseline: float, depth: Reals, cosine: Reals, color: Reals,
    disparity_noise: float, near: float, far: float, edge_px: int, dark: float, factor: float, out: Ints,
) -> None:  # fmt: skip
    """Raw depth (uint16, `factor` units a metre, 0 = missing) of rows from the exact z-depth."""
    width = depth.shape[1]
    shadow_right = np.empty(width, np.bool_)
    for row in range(row0, row1):
        # 1. Projector to the right of the camera: its column is u + d - const; scanning from the
        # right, a pixel is lit only if its projector column lies left of all columns taken so far.
        limit = 1e30
        for i in range(width):
            u = width - 1 - i
            z = depth[row, u]
            if z <= 0.0:
                shadow_right[u] = True
                continue
            column = u + fx * baseline / z
            shadow_right[u] = column >= limit + 0.5
            limit = min(limit, column)
        for u in range(width):
            z = depth[row, u]
            out[row, u] = 0
            if shadow_right[u] or z < near or z > far:
                continue
            h = _hash(seed, row * width + u)
            # 3a. Depth edges: the correlation window (about 9x9 pixels) mixes two surfaces.
            lowest, highest = _depths_around(depth, row, u, edge_px)
            chance = 0.0
            step = fx * baseline * (1.0 / lowest - 1.0 / highest)
            if step > 1.0:
                chance = 0.75 if z > 0.5 * (lowest + highest) else 0.35
            # 3b. Returned light: albedo x cosine / z^2, against a threshold that varies in blotches
            # of 4x4 pixels.
            light = (
                0.3 * color[row, u, 0] + 0.59 * color[row, u, 1] + 0.11 * color[row, u, 2]
            ) / 255.0
            power = (light + 0.04) * cosine[row, u] / (z * z)
            blotch = _uniform(_hash(seed ^ np.uint64(0x5DEECE66D), (row >> 2) * width + (u >> 2)))
            if power < dark * (0.4 + 1.2 * blotch):
                chance = 1.0
            # 3c. Slant, and the far end of the range.
            if cosine[row, u] < 0.12 + 0.1 * blotch:
                chance = 1.0
            fade = (z - 0.8 * far) / (0.2 * far)
            if fade > 0.0:
                chance = max(chance, fade * fade)
            if _uniform(_hash(h, 1)) < chance:
                continue
            # 2. Disparity noise (partly common to a correlation window) and quantisation.
            common = _normal(_hash(seed ^ np.uint64(0xA5A5A5A5), (row >> 1) * width + (u >> 1)))
            noise = disparity_noise * (0.8 * common + 0.6 * _normal(h))
            disparity = math.floor((fx * baseline / z + noise) * 8.0 + 0.5) / 8.0
            if disparity > 0.0:
                measured = fx * baseline / disparity * factor + 0.5
                if near * factor <= measured < 65535.0:
                    out[row, u] = int(measured)


@dividing_kernel
def expose(
    row0: int, row1: int, seed: Scalar, color: Reals, gain: Reals, read_noise: float, shot_noise: float,
    out: Ints,
) -> None:  # fmt: skip
    """8-bit colours of rows: gain of each row, shot and read noise, rounding, clipping."""
    width = color.shape[1]
    for row in range(row0, row1):
        for u in range(width):
            h = _hash(seed, row * width + u)
            common = _normal(h)
            for ch in range(3):
                value = color[row, u, ch] * gain[row]
                sigma = math.sqrt(read_noise * read_noise + shot_noise * max(value, 0.0))
                value += sigma * (0.75 * common + 0.66 * _normal(_hash(h, ch + 7)))
                out[row, u, ch] = (
                    np.uint8(min(max(value, 0.0), 255.0) + 0.5) if value < 254.5 else np.uint8(255)
                )
