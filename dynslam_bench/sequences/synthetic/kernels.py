"""The renderer's numba kernels: intersections of rays, tiles, antialiased shading, flow, motion blur, two sensors."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import Scalar, dividing_kernel, inlined_statements
from dynslam_bench.sequences.synthetic.arithmetic import atan2 as _atan2
from dynslam_bench.sequences.synthetic.parts import BOX, ROUND_CONE
from dynslam_bench.sequences.synthetic.textures import TextureAtlas

Ints = NDArray[np.integer]
Reals = NDArray[np.floating]
Intrinsics = tuple[float, float, float, float]
"""Focal lengths and principal point, pixels."""
Vector = tuple[float, float, float]


class Tiles(NamedTuple):
    """The primitives that may be seen in each tile of the image.

    Attributes:
        columns: Tiles in a row.
        start: int32 ``[tiles + 1]`` where each tile's list begins in `members`.
        members: int32, the lists; the primitive with the nearest bound comes first.
        nearest: ``[P]`` least depth of every primitive, metres.
    """

    columns: int
    start: Ints
    members: Ints
    nearest: Reals


class Primitives(NamedTuple):
    """The shapes of a scene and where a frame sees them.

    Attributes:
        kind: int32 ``[P]``: `BOX`, `ROUND_CONE` or `QUAD`.
        camera_to_local: ``[R, P, 12]`` maps (row-major 3x4) from the camera to the primitives'
            frames: one for all rows of the image, or one for each row under a rolling shutter.
        shape: ``[P, 3]``: half extents, or height and two radii of a round cone.
    """

    kind: Ints
    camera_to_local: Reals
    shape: Reals


class Materials(NamedTuple):
    """Textures, colours and light of the primitives' faces.

    Attributes:
        texture: int32 ``[P, 6]`` number of each face's texture in the atlas.
        uv: ``[P, 6, 4]`` repeats and shift of the texture along both axes of each face.
        tint: ``[P, 3]`` factor of each colour channel.
        facets: ``[P, 6, 5]`` unit normal of each face in the camera frame (boxes and quads), its
            light, and for all primitives the texels a pixel at 1 m.
    """

    texture: Ints
    uv: Reals
    tint: Reals
    facets: Reals


class DepthModel(NamedTuple):
    """Model of the structured-light depth camera; see `settings.DepthSensor`.

    Attributes:
        fx: Focal length, pixels.
        baseline_m: Distance from the camera to the projector, metres.
        disparity_noise_px: Standard deviation of the disparity.
        near_m: Nothing nearer is measured.
        far_m: Nothing further is measured.
        edge_px: Half the window in which a depth edge spoils the correlation.
        dark: Least albedo x cosine / z^2 that still gives a measurement.
        units_per_m: Raw units of the depth images a metre.
    """

    fx: float
    baseline_m: float
    disparity_noise_px: float
    near_m: float
    far_m: float
    edge_px: int
    dark: float
    units_per_m: float


# Intersections of rays with primitives.
#
# A ray is given in the local frame of a primitive: origin + t * direction. The direction has depth
# 1 in the camera frame, so that t is the z-depth of the hit.

NEAR_M = 0.05
"""Nothing nearer than this is seen, metres."""


@dividing_kernel
def hit_box(origin: Vector, direction: Vector, half: Vector, t_max: float) -> tuple[float, int]:
    """Nearest hit of a ray with a box from outside: (t, face), face = 2 * axis + (1 if the positive side).

    Args:
        origin: Origin of the ray in the box's frame.
        direction: Direction of the ray.
        half: Half extents of the box.
        t_max: Hits from here on do not count.
    """
    # Slab method: the ray is inside the box between its last entry into and its first exit from a
    # pair of parallel planes.
    t_in = -1.0e30
    t_out = 1.0e30
    face = -1
    for axis in range(3):
        o = origin[axis]
        d = direction[axis]
        h = half[axis]
        if abs(d) < 1e-12:
            # parallel to the planes: between them or never
            if abs(o) > h:
                return 1e30, -1
        else:
            inv = 1.0 / d
            entry = (-h - o) * inv
            leave = (h - o) * inv
            entry_face = 2 * axis
            if entry > leave:
                entry, leave, entry_face = leave, entry, entry_face + 1
            if entry > t_in:
                t_in = entry
                face = entry_face
            t_out = min(t_out, leave)
    if t_in > t_out or t_in < NEAR_M or t_in >= t_max:
        return 1e30, -1
    return t_in, face


@dividing_kernel
def hit_sphere(origin: Vector, direction: Vector, dd: float, r: float, best: float) -> float:
    """Depth of the nearest hit with a sphere about the origin if it is before `best`, else that.

    Args:
        origin: Origin of the ray, metres from the sphere's centre.
        direction: Direction of the ray, of depth 1.
        dd: Squared length of the direction.
        r: Radius, metres.
        best: Depth of the nearest hit so far.
    """
    ox, oy, oz = origin
    dx, dy, dz = direction
    # |o + t d|^2 = r^2, by half the linear coefficient
    b = ox * dx + oy * dy + oz * dz
    disc = b * b - dd * (ox * ox + oy * oy + oz * oz - r * r)
    if disc < 0.0:
        return best
    t = (-b - math.sqrt(disc)) / dd
    return t if NEAR_M < t < best else best


@dividing_kernel
def hit_round_cone(origin: Vector, direction: Vector, shape: Vector, t_max: float) -> float:
    """Nearest hit with the hull of a sphere r1 at the origin and a sphere r2 at (0, 0, h); h = 0 is a sphere.

    Args:
        origin: Origin of the ray in the cone's frame.
        direction: Direction of the ray.
        shape: h, r1 and r2.
        t_max: Hits from here on do not count.
    """
    ox, oy, oz = origin
    dx, dy, dz = direction
    h, r1, r2 = shape
    best = 1e30
    dd = dx * dx + dy * dy + dz * dz
    # Bounding sphere first: most rays of a tile miss.
    cz = oz - 0.5 * h
    rb = 0.5 * h + max(r1, r2)
    b = ox * dx + oy * dy + cz * dz
    if b * b < dd * (ox * ox + oy * oy + cz * cz - rb * rb):
        return best
    # The side. Tangent cone: sin(alpha) = s = (r1 - r2) / h; x^2 + y^2 = (r1 - s z)^2 / (1 - s^2).
    if h > 0.0:
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
    # The two spheres.
    best = hit_sphere(origin, direction, dd, r1, best)
    if h > 0.0:
        best = hit_sphere((ox, oy, oz - h), direction, dd, r2, best)
    return 1e30 if best >= t_max else best


@dividing_kernel
def hit_primitive(
    kind: int, origin: Vector, direction: Vector, shape: Vector, t_max: float
) -> tuple[float, int]:
    """Nearest hit of a ray with a primitive before `t_max`: (t, face); face is -1 without one.

    Args:
        kind: `BOX`, `ROUND_CONE` or a quad.
        origin: Origin of the ray in the primitive's frame.
        direction: Direction of the ray, of depth 1.
        shape: Half extents, or height and two radii of a round cone.
        t_max: Hits from here on do not count.
    """
    # a round cone has one face
    if kind == ROUND_CONE:
        t = hit_round_cone(origin, direction, shape, t_max)
        return t, 0 if t < t_max else -1
    if kind == BOX:
        return hit_box(origin, direction, shape, t_max)
    # a quad in the plane z = 0
    t = -origin[2] / direction[2]
    x = origin[0] + t * direction[0]
    y = origin[1] + t * direction[1]
    return t, 4 if NEAR_M < t < t_max and abs(x) <= shape[0] and abs(y) <= shape[1] else -1


# Ray casting over tiles, and antialiasing of edges.

TILE = 8
"""Edge of a tile, pixels."""
_PER_TURN = 1.0 / (2.0 * math.pi)
"""Radians to turns."""
atan2 = dividing_kernel(_atan2)


@dividing_kernel
def bin_tiles(order: Ints, boxes: Ints, tiles_x: int, tiles_y: int) -> tuple[Ints, Ints]:
    """Primitive lists of all tiles, nearest bound first.

    Args:
        order: int32 ``[P]`` primitives sorted by their nearest depth; those out of view left out.
        boxes: int32 ``[P_all, 4]`` tile ranges x0, y0, x1, y1 (inclusive) of each primitive.
        tiles_x: Tiles in a row.
        tiles_y: Tiles in a column.

    Returns:
        (start int32 ``[tiles + 1]``, members of all tiles int32 ``[start[-1]]``).
    """
    # Counting sort: lengths of the lists, their starts, then the lists.
    start = np.zeros(tiles_x * tiles_y + 1, np.int32)
    for n in range(order.shape[0]):
        p = order[n]
        for ty in range(boxes[p, 1], boxes[p, 3] + 1):
            for tx in range(boxes[p, 0], boxes[p, 2] + 1):
                start[ty * tiles_x + tx + 1] += 1
    start = np.cumsum(start).astype(np.int32)
    # where the next member of each tile is written
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
    row0: int,
    row1: int,
    intrinsics: Intrinsics,
    tiles: Tiles,
    primitives: Primitives,
    hit: Ints,
    depth: Reals,
) -> None:
    """Cast a ray through every pixel centre of the rows `row0` to `row1` - 1.

    Args:
        row0: First row.
        row1: One past the last row.
        intrinsics: The camera.
        tiles: Candidates of each tile.
        primitives: The shapes.
        hit: int32 ``[H, W]``, filled with 8 * primitive + face, -1 for none.
        depth: float64 ``[H, W]``, filled with z-depths in metres, 0 for none.
    """
    fx, fy, cx, cy = intrinsics
    tiles_x, start, members, zmin = tiles
    kind, camera_to_local, shape = primitives
    width = hit.shape[1]
    for row in range(row0, row1):
        maps = camera_to_local[row % len(camera_to_local)]
        y = (row - cy) / fy
        last = -1
        for column in range(width):
            # candidates of the pixel's tile
            tile = (row // TILE) * tiles_x + column // TILE
            first = start[tile]
            end = start[tile + 1]
            if column % TILE == 0:
                last = -1
            x = (column - cx) / fx
            t = 1e30
            p = -1
            face = 0
            # What the neighbouring pixel of the tile saw is tried first: its hit ends the search
            # soon.
            for n in range(first - 1 if last >= 0 else first, end):
                q = last
                if n >= first:
                    q = members[n]
                    # no later one of the list is nearer than this hit
                    if zmin[q] >= t:
                        break
                    if q == last:
                        continue
                # the ray in the primitive's frame
                direction = (
                    maps[q, 0] * x + maps[q, 1] * y + maps[q, 2],
                    maps[q, 4] * x + maps[q, 5] * y + maps[q, 6],
                    maps[q, 8] * x + maps[q, 9] * y + maps[q, 10],
                )
                origin = (maps[q, 3], maps[q, 7], maps[q, 11])
                extent = (shape[q, 0], shape[q, 1], shape[q, 2])
                t_hit, face_hit = hit_primitive(kind[q], origin, direction, extent, t)
                if face_hit >= 0:
                    t = t_hit
                    p = q
                    face = face_hit
            # what the pixel sees
            last = p
            hit[row, column] = 8 * p + face if p >= 0 else -1
            depth[row, column] = t if p >= 0 else 0.0


@dividing_kernel
def round_cone_normal_z(z: float, shape: Vector) -> float:
    """Third component n of the normal (x, y, n), of no special length, at a point (x, y, z) of a round cone.

    Args:
        z: Local height of the point.
        shape: h, r1 and r2 of the round cone.
    """
    h, r1, r2 = shape
    normal_z = z
    if h > 0.0:
        s = (r1 - r2) / h
        if z >= h + r2 * s:
            # the sphere at (0, 0, h)
            normal_z = z - h
        elif z > r1 * s:
            # the side between the circles of tangency
            normal_z = s * (r1 - s * z) / (1.0 - s * s)
    return normal_z


@dividing_kernel
def mip_level(footprint: float, log2_size: int) -> tuple[int, float]:
    """The mip level at which a pixel covers one to two texels, and the weight of the next coarser level.

    Args:
        footprint: Square of the texels that the pixel covers, at the finest level.
        log2_size: Base-2 logarithm of the texture's edge.
    """
    level = 0
    while footprint > 4.0 and level < log2_size - 1:
        footprint *= 0.25
        level += 1
    return level, min(max((footprint - 1.0) * (1.0 / 3.0), 0.0), 1.0)


# Parts of `shade_pixels`, whose statements numba copies into it: arrays that are passed cost nothing.


@inlined_statements
def lies_on_edge(hit: Ints, row: int, column: int) -> bool:
    """Whether one of a pixel's four neighbours shows another surface; `hit` as in `cast_geometry`."""
    height, width = hit.shape
    surface = hit[row, column]
    return bool(
        (column > 0 and hit[row, column - 1] != surface)
        or (column + 1 < width and hit[row, column + 1] != surface)
        or (row > 0 and hit[row - 1, column] != surface)
        or (row + 1 < height and hit[row + 1, column] != surface)
    )


@inlined_statements
def light_round_cone(
    p: int, local: Vector, ray: Vector, maps: Reals, shape: Reals, uv: Reals, lights: Reals
) -> tuple[float, float, float, float]:
    """Texture coordinates u, v, cosine of incidence and light (Lambert's law) at a point of a round cone.

    Args:
        p: The primitive.
        local: The point in the primitive's frame, metres.
        ray: x and y of the ray of depth 1 in the camera frame, and its length.
        maps: ``[P, 12]``, see `Primitives.camera_to_local`.
        shape: See `Primitives`.
        uv: See `Materials`.
        lights: See `shade_pixels`.
    """
    lx, ly, lz = local
    x, y, norm = ray
    # u runs around the axis, v along it
    u = uv[p, 0, 2]
    v = uv[p, 0, 3]
    u += atan2(lx, ly) * _PER_TURN * uv[p, 0, 0]
    v -= lz * uv[p, 0, 1]
    # Normal into the camera frame: transpose of the linear part of (camera to local).
    extent = (shape[p, 0], shape[p, 1], shape[p, 2])
    nz = round_cone_normal_z(lz, extent)
    nu = maps[p, 0] * lx + maps[p, 4] * ly + maps[p, 8] * nz
    nv = maps[p, 1] * lx + maps[p, 5] * ly + maps[p, 9] * nz
    nw = maps[p, 2] * lx + maps[p, 6] * ly + maps[p, 10] * nz
    # cosine of incidence, and the ambient light plus that of each lamp the normal faces
    inv = 1.0 / math.sqrt(nu * nu + nv * nv + nw * nw)
    cos = abs(nu * x + nv * y + nw) * inv / norm
    light = lights[0, 3]
    for i in range(1, lights.shape[0]):
        facing = (nu * lights[i, 0] + nv * lights[i, 1] + nw * lights[i, 2]) * inv
        if facing > 0.0:
            light += facing * lights[i, 3]
    return u, v, cos, light


@inlined_statements
def light_flat_face(
    p: int, face: int, local: Vector, ray: Vector, uv: Reals, facets: Reals
) -> tuple[float, float, float, float]:
    """Texture coordinates u, v, cosine of incidence and light at a point of a box or a quad.

    Args:
        p: The primitive.
        face: The face, see `hit_box`; 4 of a quad.
        local: The point in the primitive's frame, metres.
        ray: x and y of the ray of depth 1 in the camera frame, and its length.
        uv: See `Materials`.
        facets: See `Materials`.
    """
    lx, ly, lz = local
    x, y, norm = ray
    # normal and light are the same all over a flat face
    along_ray = facets[p, face, 0] * x + facets[p, face, 1] * y + facets[p, face, 2]
    cos = abs(along_ray) / norm
    light = facets[p, face, 3]
    repeats_u = uv[p, face, 0]
    repeats_v = uv[p, face, 1]
    u = uv[p, face, 2]
    v = uv[p, face, 3]
    if face < 4:
        # upright faces: v runs down, u to the right as seen from outside
        side = repeats_u if (face & 1) else -repeats_u
        u += ly * side if face < 2 else -lx * side
        v -= lz * repeats_v
    else:
        # faces that look up or down, and quads
        u += lx * repeats_u
        v -= ly * repeats_v
    return u, v, cos, light


@inlined_statements
def filter_texture(
    texels: NDArray[np.uint8],
    level_offset: Ints,
    log2_size: Ints,
    number: int,
    u: float,
    v: float,
    footprint: float,
    light: float,
) -> tuple[float, float, float]:
    """Red, green and blue of a texture in a light, by trilinear filtering: bilinear samples of two mip levels.

    Args:
        texels: See `TextureAtlas`, as for the next two.
        level_offset: Where each mip level begins.
        log2_size: Size of each texture.
        number: Number of the texture.
        u: Texture coordinate; the texture is 1 wide, and wraps around.
        v: Texture coordinate along the other axis.
        footprint: Square of the texels that the pixel covers at the finest level.
        light: Factor on the colour.
    """
    # unsigned: an index that may be negative costs a test
    one = np.uint64(1)
    two = np.uint64(2)
    red = 0.0
    green = 0.0
    blue = 0.0
    log2 = log2_size[number]
    level, blend = mip_level(footprint, log2)
    u -= math.floor(u)
    v -= math.floor(v)
    for upper in range(2 if blend > 0.0 else 1):
        bits = log2 - level - upper
        size = 1 << bits
        base = level_offset[number, level + upper]
        # positive, so that int() floors
        fu = u * size + (size - 0.5)
        fv = v * size + (size - 0.5)
        iu = int(fu)
        iv = int(fv)
        au = fu - iu
        av = fv - iv
        # the four texels around the point; the texture wraps around
        u0 = iu & (size - 1)
        v0 = (iv & (size - 1)) << bits
        u1 = (iu + 1) & (size - 1)
        v1 = ((iv + 1) & (size - 1)) << bits
        a = np.uint64(base + ((v0 + u0) << 2))
        b = np.uint64(base + ((v0 + u1) << 2))
        c = np.uint64(base + ((v1 + u0) << 2))
        d = np.uint64(base + ((v1 + u1) << 2))
        # bilinear weights, times the light and the share of this mip level
        weight = light * (blend if upper else 1.0 - blend)
        wa = (1.0 - au) * (1.0 - av) * weight
        wb = au * (1.0 - av) * weight
        wc = (1.0 - au) * av * weight
        wd = au * av * weight
        red += wa * texels[a] + wb * texels[b] + wc * texels[c] + wd * texels[d]
        green += (
            wa * texels[a + one]
            + wb * texels[b + one]
            + wc * texels[c + one]
            + wd * texels[d + one]
        )
        blue += (
            wa * texels[a + two]
            + wb * texels[b + two]
            + wc * texels[c + two]
            + wd * texels[d + two]
        )
    return red, green, blue


@dividing_kernel
def shade_pixels(
    row0: int,
    row1: int,
    intrinsics: Intrinsics,
    tiles: Tiles,
    primitives: Primitives,
    materials: Materials,
    atlas: TextureAtlas,
    lights: Reals,
    hit: Ints,
    depth: Reals,
    jitter: Reals,
    color: Reals,
    cosine: Reals,
) -> None:
    """Shade the pixels of the rows `row0` to `row1` - 1.

    A pixel inside a surface has the colour at its centre. A pixel on an edge has the mean of the
    `jitter` samples; each surface that these meet is shaded once, at the first of its samples.

    Args:
        row0: First row.
        row1: One past the last row.
        intrinsics: The camera.
        tiles: Candidates of each tile.
        primitives: The shapes.
        materials: What their faces look like.
        atlas: The textures.
        lights: ``[1 + lamps, 4]`` direction in the camera frame and strength; row 0 is the ambient
            light.
        hit: int32 ``[H, W]``, see `cast_geometry`.
        depth: float64 ``[H, W]``, see `cast_geometry`.
        jitter: ``[S, 2]`` offsets of the samples from the pixel's centre, pixels.
        color: float32 ``[H, W, 3]``, filled with colours from 0 to 255.
        cosine: float32 ``[H, W]``, filled with the cosine of incidence at the pixel's centre.
    """
    fx, fy, cx, cy = intrinsics
    tiles_x, start, members, zmin = tiles
    kind, camera_to_local, shape = primitives
    texture, uv, tint, facets = materials
    texels, level_offset, log2_size = atlas
    width = hit.shape[1]
    samples = jitter.shape[0]
    sample_weight = 1.0 / samples
    for row in range(row0, row1):
        maps = camera_to_local[row % len(camera_to_local)]
        for column in range(width):
            centre_surface = hit[row, column]
            edge = lies_on_edge(hit, row, column)
            # sum of the samples
            red = 0.0
            green = 0.0
            blue = 0.0
            # the surface at the pixel's centre
            centre_red = 0.0
            centre_green = 0.0
            centre_blue = 0.0
            centre_cos = 0.0
            # the surface that was shaded last
            last_surface = -2
            last_red = 0.0
            last_green = 0.0
            last_blue = 0.0
            centre_primitive = centre_surface >> 3
            tile = (row // TILE) * tiles_x + column // TILE
            first = start[tile]
            end = start[tile + 1]
            # Sample -1 is the pixel centre, which the first pass has traced.
            for sample in range(-1, samples if edge else 0):
                x = (column - cx) / fx
                y = (row - cy) / fy
                surface = centre_surface
                t = depth[row, column]
                p = centre_primitive
                face = centre_surface & 7
                # Cast the ray of a sample beside the centre, as `cast_geometry` does.
                if sample >= 0:
                    x = (column + jitter[sample, 0] - cx) / fx
                    y = (row + jitter[sample, 1] - cy) / fy
                    t = 1e30
                    p = -1
                    face = 0
                    for n in range(first - 1 if centre_primitive >= 0 else first, end):
                        q = centre_primitive
                        if n >= first:
                            q = members[n]
                            if zmin[q] >= t:
                                break
                            if q == centre_primitive:
                                continue
                        direction = (
                            maps[q, 0] * x + maps[q, 1] * y + maps[q, 2],
                            maps[q, 4] * x + maps[q, 5] * y + maps[q, 6],
                            maps[q, 8] * x + maps[q, 9] * y + maps[q, 10],
                        )
                        origin = (maps[q, 3], maps[q, 7], maps[q, 11])
                        extent = (shape[q, 0], shape[q, 1], shape[q, 2])
                        t_hit, face_hit = hit_primitive(kind[q], origin, direction, extent, t)
                        if face_hit >= 0:
                            t = t_hit
                            p = q
                            face = face_hit
                    # A surface that is shaded already is not shaded again.
                    surface = 8 * p + face if p >= 0 else -1
                    if surface == centre_surface:
                        red = red + centre_red
                        green = green + centre_green
                        blue = blue + centre_blue
                        continue
                if surface == last_surface:
                    red = red + last_red
                    green = green + last_green
                    blue = blue + last_blue
                    continue
                last_surface = surface
                last_red = 0.0
                last_green = 0.0
                last_blue = 0.0
                cos = 0.0
                if surface >= 0:
                    # The point in the primitive's frame.
                    lx = maps[p, 3] + t * (maps[p, 0] * x + maps[p, 1] * y + maps[p, 2])
                    ly = maps[p, 7] + t * (maps[p, 4] * x + maps[p, 5] * y + maps[p, 6])
                    lz = maps[p, 11] + t * (maps[p, 8] * x + maps[p, 9] * y + maps[p, 10])
                    norm = math.sqrt(x * x + y * y + 1.0)
                    # Texture coordinates, cosine of incidence and light.
                    local = (lx, ly, lz)
                    ray = (x, y, norm)
                    if kind[p] == ROUND_CONE:
                        u, v, cos, light = light_round_cone(p, local, ray, maps, shape, uv, lights)
                    else:
                        u, v, cos, light = light_flat_face(p, face, local, ray, uv, facets)
                    # Texel footprint squared, between those along and across a slanted surface.
                    footprint = facets[p, face, 4] * t
                    footprint = footprint * footprint / max(cos, 0.05)
                    # Colour of the texture in this light, times the primitive's tint.
                    last_red, last_green, last_blue = filter_texture(
                        texels, level_offset, log2_size, texture[p, face], u, v, footprint, light
                    )
                    last_red = last_red * tint[p, 0]
                    last_green = last_green * tint[p, 1]
                    last_blue = last_blue * tint[p, 2]
                # the centre is kept for pixels without an edge; the other samples are averaged
                if sample < 0:
                    centre_red = last_red
                    centre_green = last_green
                    centre_blue = last_blue
                    centre_cos = cos
                else:
                    red = red + last_red
                    green = green + last_green
                    blue = blue + last_blue
            if edge:
                red = red * sample_weight
                green = green * sample_weight
                blue = blue * sample_weight
            else:
                red = centre_red
                green = centre_green
                blue = centre_blue
            color[row, column, 0] = red
            color[row, column, 1] = green
            color[row, column, 2] = blue
            cosine[row, column] = centre_cos


# Motion in the image: exact flow, and blur along it. Rows are independent.

MOST_TAPS = 16
"""Samples of the longest blur."""
_SHORTEST_BLUR_PX = 0.75
"""Below this motion while the shutter is open a pixel keeps its colour."""


def tap_shares() -> Reals:
    """Places of a blur's taps, as shares of its length from the middle: ``[n, i]`` for tap i of n."""
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

    Where nothing is hit or the point leaves the front of the camera, the flow is NaN.

    Args:
        row0: First row.
        row1: One past the last row.
        intrinsics: The camera.
        hit: int32 ``[H, W]``, see `cast_geometry`.
        depth: float64 ``[H, W]``, see `cast_geometry`.
        motion: ``[P, 12]``, row-major 3x4 transforms of a point fixed to each primitive, from this
            camera's frame to the other camera's.
        flow: float32 ``[H, W, 2]``, filled.
    """
    fx, fy, cx, cy = intrinsics
    width = hit.shape[1]
    for row in range(row0, row1):
        for column in range(width):
            # no flow, unless a point is seen
            flow[row, column, 0] = flow[row, column, 1] = np.nan
            # unproject
            p = hit[row, column] >> 3
            z = depth[row, column]
            x = (column - cx) / fx * z
            y = (row - cy) / fy * z
            # into the other camera's frame, and project
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

    Unsigned indices need no test for negative ones.

    Args:
        row0: First row.
        row1: One past the last row.
        color: float32 ``[H, W, 3]``, the sharp colours.
        exact: These colours as flat float64: what all taps read is converted once.
        shares: Places of the taps, `tap_shares`.
        flow: float32 ``[H, W, 2]`` to the next frame, pixels.
        shutter: Share of the frame interval for which the shutter is open.
        blurred: float32 ``[H, W, 3]``, filled.
    """
    height, width = color.shape[:2]
    # taps stay where a texel to the right and one below exist
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
            # motion of the pixel while the shutter is open
            du = flow[row, column, 0] * shutter
            dv = flow[row, column, 1] * shutter
            length = math.sqrt(du * du + dv * dv)
            # also where the flow is NaN
            if not length > _SHORTEST_BLUR_PX:
                for ch in range(3):
                    blurred[row, column, ch] = color[row, column, ch]
                continue
            # Mean of bilinear samples along it, about one a pixel.
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
                # weights of the four pixels around the tap, of which k is the upper left and m the one below
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
#    has no depth.
# 2. The disparity fx * baseline / z carries noise and is quantised to 1/8 pixel: the depth steps
#    grow with z^2.
# 3. Correlation fails near depth edges, on dark surfaces far away, on slanted surfaces, and outside
#    the range.


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
    # mean 4 * 65535 / 2; a uniform part has the variance 65536^2 / 12
    return (total - 131070.0) * (1.7320508075688772 / 65536.0)


@dividing_kernel
def _uniform(h: Scalar) -> float:
    """Uniform in [0, 1): the upper 53 bits of a hash."""
    return float(h >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@dividing_kernel
def _mark_projector_shadow(
    depth: Reals, row: int, fx_baseline: float, in_shadow: NDArray[np.bool_]
) -> None:
    """Mark the pixels of a row that have no depth or that the projector cannot see.

    The projector stands to the right of the camera: its column is u + disparity - const. Scanning
    from the right, a pixel is lit only if its projector column lies left of all columns taken so
    far.

    Args:
        depth: Exact z-depth ``[H, W]``, metres.
        row: The row.
        fx_baseline: Focal length times baseline, pixels x metres.
        in_shadow: ``[W]``, filled.
    """
    width = depth.shape[1]
    leftmost = 1e30
    for i in range(width):
        u = width - 1 - i
        z = depth[row, u]
        if z <= 0.0:
            in_shadow[u] = True
            continue
        # the column of the projector that lights the point
        column = u + fx_baseline / z
        in_shadow[u] = column >= leftmost + 0.5
        leftmost = min(leftmost, column)


@dividing_kernel
def _depths_around(depth: Reals, row: int, u: int, reach: int) -> tuple[float, float]:
    """The least and the greatest depth of a pixel and of those `reach` away on either side, above and below.

    Args:
        depth: Exact z-depth ``[H, W]``, metres, 0 for nothing.
        row: Row of the pixel.
        u: Column of the pixel.
        reach: Pixels.
    """
    height, width = depth.shape
    # the pixel itself, then the four others that have a depth
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
    row0: int,
    row1: int,
    seed: Scalar,
    sensor: DepthModel,
    depth: Reals,
    cosine: Reals,
    color: Reals,
    out: Ints,
) -> None:
    """Measure the depth of the rows `row0` to `row1` - 1, by the model above.

    Args:
        row0: First row.
        row1: One past the last row.
        seed: Seed of this frame's noise.
        sensor: The depth camera.
        depth: Exact z-depth ``[H, W]``, metres.
        cosine: Cosine of incidence ``[H, W]``.
        color: Colour ``[H, W, 3]`` from 0 to 255, which stands for the albedo.
        out: uint16 ``[H, W]``, filled with raw depths; 0 is missing.
    """
    width = depth.shape[1]
    fx_baseline = sensor.fx * sensor.baseline_m
    near = sensor.near_m
    far = sensor.far_m
    factor = sensor.units_per_m
    in_shadow = np.empty(width, np.bool_)
    for row in range(row0, row1):
        # 1. Shadow of the projector.
        _mark_projector_shadow(depth, row, fx_baseline, in_shadow)
        for u in range(width):
            z = depth[row, u]
            out[row, u] = 0
            if in_shadow[u] or z < near or z > far:
                continue
            h = _hash(seed, row * width + u)
            # 3a. Depth edges: the correlation window (about 9x9 pixels) mixes two surfaces.
            lowest, highest = _depths_around(depth, row, u, sensor.edge_px)
            loss_probability = 0.0
            disparity_step = fx_baseline * (1.0 / lowest - 1.0 / highest)
            if disparity_step > 1.0:
                # the farther surface is lost more often
                loss_probability = 0.75 if z > 0.5 * (lowest + highest) else 0.35
            # 3b. Returned light: albedo x cosine / z^2, against a threshold that varies in blotches
            # of 4x4 pixels.
            albedo = (
                0.3 * color[row, u, 0] + 0.59 * color[row, u, 1] + 0.11 * color[row, u, 2]
            ) / 255.0
            returned_light = (albedo + 0.04) * cosine[row, u] / (z * z)
            blotch = _uniform(_hash(seed ^ np.uint64(0x5DEECE66D), (row >> 2) * width + (u >> 2)))
            if returned_light < sensor.dark * (0.4 + 1.2 * blotch):
                loss_probability = 1.0
            # 3c. Slant, and the far end of the range.
            if cosine[row, u] < 0.12 + 0.1 * blotch:
                loss_probability = 1.0
            fade = (z - 0.8 * far) / (0.2 * far)
            if fade > 0.0:
                loss_probability = max(loss_probability, fade * fade)
            if _uniform(_hash(h, 1)) < loss_probability:
                continue
            # 2. Disparity noise (partly common to a correlation window) and quantisation.
            common = _normal(_hash(seed ^ np.uint64(0xA5A5A5A5), (row >> 1) * width + (u >> 1)))
            noise = sensor.disparity_noise_px * (0.8 * common + 0.6 * _normal(h))
            disparity = math.floor((fx_baseline / z + noise) * 8.0 + 0.5) / 8.0
            if disparity > 0.0:
                raw = fx_baseline / disparity * factor + 0.5
                if near * factor <= raw < 65535.0:
                    out[row, u] = int(raw)


@dividing_kernel
def expose(
    row0: int,
    row1: int,
    seed: Scalar,
    color: Reals,
    gain: Reals,
    read_noise: float,
    shot_noise: float,
    out: Ints,
) -> None:
    """8-bit colours of rows: gain of each row, shot and read noise, rounding, clipping.

    Args:
        row0: First row.
        row1: One past the last row.
        seed: Seed of this frame's noise.
        color: Colour ``[H, W, 3]`` from 0 to 255.
        gain: Factor of each row ``[H]``.
        read_noise: Standard deviation of the noise without light, grey levels.
        shot_noise: Variance of the noise a grey level of signal.
        out: uint8 ``[H, W, 3]``, filled.
    """
    width = color.shape[1]
    for row in range(row0, row1):
        for u in range(width):
            h = _hash(seed, row * width + u)
            # noise that the three channels of a pixel share
            common = _normal(h)
            for ch in range(3):
                value = color[row, u, ch] * gain[row]
                # variances of read noise (constant) and shot noise (proportional to the signal) add
                sigma = math.sqrt(read_noise * read_noise + shot_noise * max(value, 0.0))
                value += sigma * (0.75 * common + 0.66 * _normal(_hash(h, ch + 7)))
                out[row, u, ch] = (
                    np.uint8(min(max(value, 0.0), 255.0) + 0.5) if value < 254.5 else np.uint8(255)
                )
