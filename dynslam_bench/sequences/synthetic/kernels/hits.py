"""Where a ray meets a primitive."""

from __future__ import annotations

import math

from dynslam_bench.core.compiled import dividing_kernel

NEAR_M = 0.05
"""Nothing nearer than this is seen, metres."""


@dividing_kernel
def hit_box(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, hx: float, hy: float, hz: float, t_max: float
) -> tuple[float, int]:
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
    if t_in > t_out or t_in < NEAR_M or t_in >= t_max:
        return 1e30, -1
    return t_in, face


@dividing_kernel
def hit_round_cone(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, h: float, r1: float, r2: float, t_max: float
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
            if NEAR_M < t and r1 * s <= z <= h + r2 * s and r1 - s * z > 0.0:
                best = t
    b = ox * dx + oy * dy + oz * dz
    disc = b * b - dd * (ox * ox + oy * oy + oz * oz - r1 * r1)
    if disc >= 0.0:
        t = (-b - math.sqrt(disc)) / dd
        if NEAR_M < t < best:
            best = t
    if h > 0.0:
        cz = oz - h
        b = ox * dx + oy * dy + cz * dz
        disc = b * b - dd * (ox * ox + oy * oy + cz * cz - r2 * r2)
        if disc >= 0.0:
            t = (-b - math.sqrt(disc)) / dd
            if NEAR_M < t < best:
                best = t
    if best >= t_max:
        return 1e30
    return best
