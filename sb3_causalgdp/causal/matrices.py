"""Products and factors of matrices of float64, by torch, which is faster than numpy where they are not small."""

import numpy as np
import torch as th

SMALL = 4096


def product(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """
    :param one: Shape (n, m)
    :param other: Shape (m, p)
    :return: the product of the two matrices, shape (n, p)
    """
    return one @ other if other.size < SMALL else (th.from_numpy(one) @ th.from_numpy(other)).numpy()


def cholesky_in_place(matrix: np.ndarray) -> th.Tensor:
    """
    :param matrix: Symmetric and positive definite, its rows contiguous, shape (n, n); overwritten
    :return: lower Cholesky factor, its columns contiguous, in the memory of the matrix, shape (n, n)
    :raises torch.linalg.LinAlgError: when the matrix is not positive definite
    """
    # LAPACK factorises by columns: no copy is made of a matrix that is laid out so
    by_columns = th.from_numpy(matrix).T
    return th.linalg.cholesky(by_columns, out=by_columns)
