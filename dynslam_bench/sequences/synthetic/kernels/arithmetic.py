"""Functions and products that give the same bits on every processor.

They are made of additions, multiplications, divisions and square roots, which IEEE 754 defines to the bit. The last
bits of others differ: numpy's `@` and `norm` call a BLAS with a kernel for each processor, numpy's functions have one
for each width of SIMD vectors, and those of the C library depend on its version and on fused multiply-adds. The
functions here differ from numpy's by one unit in the last place at most where the result is above 1, else by 2.3e-16.
"""

from __future__ import annotations

import math
from functools import reduce
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import Scalar, dividing_kernel

Array = NDArray[np.float64]

_HALF_PI = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
"""Pi / 2 in parts of 33 bits, so that a product with a whole number below 2^20 is exact (fdlibm's)."""
_LN_2 = (6.93147180369123816490e-01, 1.90821492927058770002e-10)
_SINE = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(9))
_COSINE = tuple((-1.0) ** k / math.factorial(2 * k) for k in range(10))
_EXPONENTIAL = tuple(1.0 / math.factorial(k) for k in range(15))
_ARCTANGENT = tuple((-1.0) ** k / (2 * k + 1) for k in range(12))
_LOGARITHM = tuple(1.0 / (2 * k + 1) for k in range(11))


@dividing_kernel
def _polynomial(coefficients: tuple[float, ...], x: Scalar) -> Scalar:
    total = 0.0
    for k in range(len(coefficients) - 1, -1, -1):
        total = total * x + coefficients[k]
    return total


@dividing_kernel
def _sine(x: Scalar, quarters: int) -> Scalar:
    """The sine of x + quarters * pi / 2; x within 1e6."""
    turns = math.floor(x * 0.6366197723675814 + 0.5)
    rest = ((x - turns * _HALF_PI[0]) - turns * _HALF_PI[1]) - turns * _HALF_PI[2]
    quadrant = (int(turns) + quarters) & 3
    square = rest * rest
    value = _polynomial(_COSINE, square) if quadrant & 1 else rest * _polynomial(_SINE, square)
    return -value if quadrant & 2 else value


@dividing_kernel
def atan2(y: Scalar, x: Scalar) -> Scalar:
    """The angle of a vector (x, y), for kernels; 0 for the zero vector."""
    large, small = max(abs(x), abs(y)), min(abs(x), abs(y))
    if large == 0.0:
        return 0.0
    ratio = small / large
    for _ in range(2):  # the angle is halved twice
        ratio = ratio / (1.0 + math.sqrt(1.0 + ratio * ratio))
    angle = 4.0 * ratio * _polynomial(_ARCTANGENT, ratio * ratio)
    if abs(y) > abs(x):
        angle = 0.5 * math.pi - angle
    if x < 0.0:
        angle = math.pi - angle
    return -angle if y < 0.0 else angle


@dividing_kernel
def _exponential(x: Scalar) -> Scalar:
    twos = math.floor(x * 1.4426950408889634 + 0.5)
    value = _polynomial(_EXPONENTIAL, (x - twos * _LN_2[0]) - twos * _LN_2[1])
    for _ in range(min(abs(int(twos)), 1100)):
        value *= 2.0 if twos > 0 else 0.5
    return value


@dividing_kernel
def _logarithm(x: Scalar) -> Scalar:
    """Of a positive number."""
    twos = 0
    while x > 1.4142135623730951:
        x, twos = 0.5 * x, twos + 1
    while x < 0.7071067811865476:
        x, twos = 2.0 * x, twos - 1
    z = (x - 1.0) / (x + 1.0)
    return 2.0 * z * _polynomial(_LOGARITHM, z * z) + twos * _LN_2[1] + twos * _LN_2[0]


@dividing_kernel
def _sines(values: Array, quarters: int, out: Array) -> None:
    for i in range(values.shape[0]):
        out[i] = _sine(values[i], quarters)


@dividing_kernel
def _exponentials(values: Array, out: Array) -> None:
    for i in range(values.shape[0]):
        out[i] = _exponential(values[i])


@dividing_kernel
def _angles(y: Array, x: Array, out: Array) -> None:
    for i in range(y.shape[0]):
        out[i] = atan2(y[i], x[i])


@overload
def sin(x: float) -> float: ...
@overload
def sin(x: Array) -> Array: ...
def sin(x: float | Array) -> float | Array:
    """Sine of a number or of an array, radians; x within 1e6."""
    return _of_each(_sines, x, 0) if isinstance(x, np.ndarray) else float(_sine(float(x), 0))


@overload
def cos(x: float) -> float: ...
@overload
def cos(x: Array) -> Array: ...
def cos(x: float | Array) -> float | Array:
    """Cosine of a number or of an array, radians; x within 1e6."""
    return _of_each(_sines, x, 1) if isinstance(x, np.ndarray) else float(_sine(float(x), 1))


def exp(x: Array) -> Array:
    """Exponential of an array."""
    return _of_each(_exponentials, x)


def arctan2(y: Array, x: Array) -> Array:
    """Angles of vectors (x, y), arrays of one dimension."""
    out = np.empty(len(y))
    _angles(np.ascontiguousarray(y), np.ascontiguousarray(x), out)
    return out


def power(x: float, exponent: float) -> float:
    """A power of a number that is not negative."""
    return float(_exponential(exponent * _logarithm(x))) if x > 0 else 0.0**exponent


def _of_each(kernel: Any, x: Array, *options: int) -> Array:
    out = np.empty(x.size)
    kernel(np.ascontiguousarray(x, dtype=np.float64).ravel(), *options, out)
    return out.reshape(x.shape)


def product(*factors: Array) -> Array:
    """What ``a @ b @ ...`` is, stacks of matrices and vectors included, each sum from its first term to its last."""
    return reduce(_product, factors)


def _product(a: Array, b: Array) -> Array:
    if b.ndim == 1:
        total = a[..., 0] * b[0]
        for k in range(1, len(b)):
            total = total + a[..., k] * b[k]
        return np.asarray(total)
    if a.ndim == 1:
        return np.asarray(_product(np.swapaxes(b, -1, -2), a))
    total = a[..., :, :1] * b[..., :1, :]
    for k in range(1, b.shape[-2]):
        total += a[..., :, k : k + 1] * b[..., k : k + 1, :]
    return np.asarray(total)


def norm(vectors: Array) -> Array:
    """Euclidean lengths along the last axis."""
    total = vectors[..., 0] * vectors[..., 0]
    for k in range(1, vectors.shape[-1]):
        total = total + vectors[..., k] * vectors[..., k]
    return np.asarray(np.sqrt(total))
