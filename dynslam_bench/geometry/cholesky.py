"""Small symmetric systems, solved inside compiled loops."""

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.compiled import kernel


@kernel
def cholesky_solve(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Solve ``a x = b`` in place for a symmetric positive definite `a`; `b` becomes x. False if it is not definite."""
    n = a.shape[0]
    for j in range(n):
        for i in range(j, n):
            s = a[i, j]
            for k in range(j):
                s -= a[i, k] * a[j, k]
            if i == j:
                if not s > 1e-14:
                    return False
                a[j, j] = np.sqrt(s)
            else:
                a[i, j] = s / a[j, j]
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= a[i, k] * b[k]
        b[i] = s / a[i, i]
    for i in range(n - 1, -1, -1):
        s = b[i]
        for k in range(i + 1, n):
            s -= a[k, i] * b[k]
        b[i] = s / a[i, i]
    return True
