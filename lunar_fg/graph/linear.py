"""Linear algebra on many small matrices at once."""

from __future__ import annotations

import numpy as np

from frontends.errors import EstimationError
from frontends.measurements import FloatArray

# Products below this many multiplications stay on one thread in OpenBLAS; on a busy
# machine its threads cost ten times what they save at this size.
_ONE_THREAD = 200_000


def tangent_basis(points: FloatArray) -> FloatArray:
    """Three unit directions orthogonal to each unit 4-vector (Householder), (L, 4, 3)."""
    sign = np.where(points[:, 3] >= 0.0, 1.0, -1.0)
    v = points.copy()
    v[:, 3] += sign
    scale = 2.0 / np.einsum("li,li->l", v, v)
    basis = -scale[:, None, None] * v[:, :, None] * v[:, None, :3]
    basis[:, :3, :] += np.eye(3)
    return np.asarray(basis)


def gram(rows: FloatArray) -> FloatArray:
    """``rows.T @ rows`` in blocks small enough for one thread."""
    count, width = rows.shape
    height = max(8, _ONE_THREAD // width**2)
    blocks = -(-count // height)
    padded = np.zeros((blocks * height, width))
    padded[:count] = rows
    stacked = padded.reshape(blocks, height, width)
    return np.asarray((stacked.transpose(0, 2, 1) @ stacked).sum(axis=0))


def inverse_positive(matrix: FloatArray) -> FloatArray:
    """Inverse of a matrix that must be positive definite."""
    try:
        root = np.linalg.inv(np.linalg.cholesky(matrix))
    except np.linalg.LinAlgError as error:
        raise EstimationError("its measurements do not fix all poses") from error
    return np.asarray(root.T @ root)
