"""Small symmetric systems of equations, solved in place by Cholesky's method."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pipelines.compiled import compiled

Floats = NDArray[np.float64]

SMALLEST_PIVOT = 1e-12
"""A pivot below this share of its diagonal element counts as 0: the matrix is singular."""


@compiled
def factor(h: Floats, n: int) -> bool:
    """Put L of H = L Lᵀ into the lower triangle of the first n rows; False if H is not positive definite."""
    for j in range(n):
        pivot = h[j, j]
        for k in range(j):
            pivot -= h[j, k] * h[j, k]
        if not pivot > SMALLEST_PIVOT * h[j, j]:
            return False
        h[j, j] = math.sqrt(pivot)
        for i in range(j + 1, n):
            total = h[i, j]
            for k in range(j):
                total -= h[i, k] * h[j, k]
            h[i, j] = total / h[j, j]
    return True


@compiled
def substitute(factored: Floats, x: Floats, n: int) -> None:
    """Solve L Lᵀ x = b in place of b = `x` [n], with the factor of `factor`."""
    for i in range(n):
        for k in range(i):
            x[i] -= factored[i, k] * x[k]
        x[i] /= factored[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= factored[k, i] * x[k]
        x[i] /= factored[i, i]


@compiled
def inverse(h: Floats, n: int) -> Floats:
    """H⁻¹ [n, n] of a symmetric matrix whose lower triangle is given; NaN if it is not positive definite."""
    factored = h.copy()
    found = np.zeros((n, n))
    for j in range(n):
        found[j, j] = 1.0
    if not factor(factored, n):
        found[:] = math.nan
        return found
    for j in range(n):
        substitute(factored, found[j], n)
    return found


@compiled
def largest(x: Floats) -> float:
    """|x|∞ of a vector; NaN counts as infinite."""
    found = 0.0
    for value in x:  # NaN differs from itself
        found = max(found, abs(value)) if value == value else math.inf
    return found
