"""Functions and products that give the same bits on every processor.

They are made of additions, multiplications, divisions and square roots, which IEEE 754 defines to
the bit. The last bits of others differ. Numpy's `@` and `norm` call a BLAS with a kernel for each
processor, and its functions have one for each width of SIMD vectors. Those of the C library depend
on its version and on fused multiply-adds. The functions here differ from numpy's by one unit in the
last place at most where the result is above 1, else by 2.3e-16.
"""

import math
from functools import reduce
from operator import iadd
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

# Each function reduces its argument to a small range, where a polynomial is exact enough: the Taylor
# series up to the term that no longer changes the last bit.

Array = NDArray[np.float64]
Reals = TypeVar("Reals", float, Array)

_HALF_PI = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
"""Pi / 2 in parts of 33 bits, so that a product with a whole number below 2^20 is exact (fdlibm's)."""
_LN_2 = (6.93147180369123816490e-01, 1.90821492927058770002e-10)
"""Natural logarithm of 2 in two parts, as `_HALF_PI`."""

# Taylor coefficients: of sin x / x and cos x in x^2, of exp x in x, of arctan x / x in x^2, and of
# log((1 + z) / (1 - z)) / 2 z in z^2
_SINE = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(9))
_COSINE = tuple((-1.0) ** k / math.factorial(2 * k) for k in range(10))
_EXPONENTIAL = tuple(1.0 / math.factorial(k) for k in range(15))
_ARCTANGENT = tuple((-1.0) ** k / (2 * k + 1) for k in range(12))
_LOGARITHM = tuple(1.0 / (2 * k + 1) for k in range(11))


def _polynomial(coefficients: tuple[float, ...], x: Any) -> Any:
    """A polynomial's value by Horner's rule; the constant coefficient is first."""
    total = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        total = total * x + coefficient
    return total


def _sine(x: float | Array, quarters: int) -> Any:
    """The sine of x + quarters * pi / 2."""
    many = isinstance(x, np.ndarray)
    x = x if many else float(x)

    # the nearest multiple of pi / 2, and the rest, at most pi / 4 (Cody and Waite's reduction)
    turns: Any = (
        np.floor(x * 0.6366197723675814 + 0.5) if many else math.floor(x * 0.6366197723675814 + 0.5)
    )
    rest = ((x - turns * _HALF_PI[0]) - turns * _HALF_PI[1]) - turns * _HALF_PI[2]

    # sine or cosine of the rest, with its sign, by the quadrant
    square = rest * rest
    if not many:
        quadrant = (int(turns) + quarters) & 3
        value = _polynomial(_COSINE, square) if quadrant & 1 else rest * _polynomial(_SINE, square)
        return -value if quadrant & 2 else value
    quadrants = (turns.astype(np.int64) + quarters) & 3
    values = np.where(
        quadrants & 1, _polynomial(_COSINE, square), rest * _polynomial(_SINE, square)
    )
    return np.where(quadrants & 2, -values, values)


def sin(x: Reals) -> Reals:
    """Sine of a number or of an array, radians; x within 1e6."""
    return _sine(x, 0)  # type: ignore[no-any-return]


def cos(x: Reals) -> Reals:
    """Cosine of a number or of an array, radians; x within 1e6."""
    return _sine(x, 1)  # type: ignore[no-any-return]


def atan2(y: float, x: float) -> float:
    """The angle of a vector (x, y); 0 for the zero vector. It is compiled into a kernel as well."""
    # the ratio of the smaller to the larger coordinate, at most 1
    large = max(abs(x), abs(y))
    small = min(abs(x), abs(y))
    if large == 0.0:
        return 0.0
    ratio = small / large

    # halve the angle twice: tan(a / 2) = tan a / (1 + sqrt(1 + tan^2 a))
    for _ in range(2):
        ratio = ratio / (1.0 + math.sqrt(1.0 + ratio * ratio))

    # its arctangent, times four
    square = ratio * ratio
    total = 0.0
    for k in range(len(_ARCTANGENT) - 1, -1, -1):
        total = total * square + _ARCTANGENT[k]
    angle = 4.0 * ratio * total

    # back from the first eighth of a turn to the vector's own
    if abs(y) > abs(x):
        angle = 0.5 * math.pi - angle
    if x < 0.0:
        angle = math.pi - angle
    return -angle if y < 0.0 else angle


def arctan2(y: Array, x: Array) -> Array:
    """Angles of vectors (x, y), arrays of one dimension."""
    return np.array([atan2(v, u) for v, u in zip(y.tolist(), x.tolist(), strict=True)])


def exp(x: Array) -> Array:
    """Exponential of an array."""
    # exp x = 2^k exp r, with r at most half of ln 2
    twos = np.floor(x * 1.4426950408889634 + 0.5)
    value = _polynomial(_EXPONENTIAL, (x - twos * _LN_2[0]) - twos * _LN_2[1])
    return np.asarray(np.ldexp(value, twos.astype(np.int32)))


def power(x: float, exponent: float) -> float:
    """A power of a number that is not negative."""
    if x <= 0:
        return float(0.0**exponent)
    # x = m 2^k, with m between sqrt(1/2) and sqrt(2)
    mantissa, twos = math.frexp(x)
    if mantissa < 0.7071067811865476:
        mantissa = 2.0 * mantissa
        twos = twos - 1

    # log m by the series of z = (m - 1) / (m + 1), and the power as exp(exponent log x)
    z = (mantissa - 1.0) / (mantissa + 1.0)
    logarithm = 2.0 * z * _polynomial(_LOGARITHM, z * z) + twos * _LN_2[1] + twos * _LN_2[0]
    return float(exp(np.array(exponent * logarithm)))


def product(*factors: Array) -> Array:
    """Product ``a @ b @ ...``, stacks of matrices and vectors included, each sum from its first term to its last."""
    return reduce(_product, factors)


def _product(a: Array, b: Array) -> Array:
    """The product ``a @ b``, summed term by term."""
    # a row vector times a matrix is the transposed matrix times that vector
    if a.ndim == 1 < b.ndim:
        a, b = np.swapaxes(b, -1, -2), a
    if b.ndim == 1:
        return reduce(iadd, (a[..., k] * b[k] for k in range(len(b))))
    return reduce(iadd, (a[..., :, k : k + 1] * b[..., k : k + 1, :] for k in range(b.shape[-2])))


def norm(vectors: Array) -> Array:
    """Euclidean lengths along the last axis."""
    columns = np.moveaxis(vectors, -1, 0)
    return np.asarray(np.sqrt(reduce(iadd, columns * columns)))
