"""
Products and factors of matrices of float64. Of symmetric matrices one triangle is enough, and factors take the place of the
matrix: at the sizes of many causes, another matrix of the same size is felt.
"""

import numpy as np
import torch as th
from scipy.linalg import blas, cho_factor, lapack

SMALL = 4096


def product(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """
    :param one: Shape (n, m)
    :param other: Shape (m, p)
    :return: the product of the two matrices, shape (n, p)
    """
    return one @ other if other.size < SMALL else (th.from_numpy(one) @ th.from_numpy(other)).numpy()


def cholesky_in_place(matrix: np.ndarray) -> np.ndarray:
    """
    :param matrix: Symmetric and positive definite, its rows contiguous, shape (n, n); overwritten
    :return: lower Cholesky factor, its columns contiguous, in the memory of the matrix, of which the upper triangle stays as
        it was; shape (n, n)
    :raises numpy.linalg.LinAlgError: when the matrix is not positive definite
    """
    # LAPACK factorises by columns: no copy is made of a matrix that is laid out so
    factor, _ = cho_factor(matrix.T, lower=True, overwrite_a=True, check_finite=False)
    return factor


def inverse_in_place(factor: np.ndarray) -> np.ndarray:
    """
    :param factor: What ``cholesky_in_place`` returned, shape (n, n); overwritten
    :return: inverse of the matrix that was factorised: its lower triangle, in the memory of the factor, shape (n, n)
    """
    inverse, _ = lapack.dpotri(factor, lower=1, overwrite_c=1)
    return inverse


def symmetric_product(lower: np.ndarray, right: np.ndarray) -> np.ndarray:
    """
    :param lower: Lower triangle of a symmetric matrix, its columns contiguous, shape (n, n)
    :param right: Rows contiguous, shape (n, p)
    :return: the product of the two, shape (n, p)
    """
    # What is contiguous by rows is so by columns when it is transposed: BLAS makes no copy then
    return blas.dsymm(1.0, lower, right.T, side=1, lower=1).T
