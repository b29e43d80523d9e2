"""Dense solves of a few unknowns inside compiled loops, where a call of LAPACK would cost more than the work."""

from __future__ import annotations

from math import sqrt

import numpy as np

from rigwake._kernels import inlined
from rigwake._types import Array


@inlined
def cholesky_solve(matrix: Array, right_side: Array) -> bool:
    """Solve in place by L L^T, leaving L in the lower half; False if not positive definite."""
    n = len(right_side)
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i > j:
                matrix[i, j] = total / matrix[j, j]
            elif total > 1e-9:
                matrix[i, i] = sqrt(total)
            else:
                return False
        for k in range(i):
            right_side[i] -= matrix[i, k] * right_side[k]
        right_side[i] /= matrix[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right_side[i] -= matrix[k, i] * right_side[k]
        right_side[i] /= matrix[i, i]
    return True


@inlined
def position_spread(factor: Array) -> float:
    """Mean of the first two diagonal entries of `(L L^T)^-1`."""
    total = 0.0
    column = np.empty(len(factor))
    for axis in range(2):
        for i in range(len(factor)):
            right_side = 1.0 if i == axis else 0.0
            for k in range(i):
                right_side -= factor[i, k] * column[k]
            column[i] = right_side / factor[i, i]
            total += column[i] * column[i]
    return total / 2
