"""Faster start of numba's kernels."""

from __future__ import annotations


def leave_out_blas() -> None:
    """Keep numba from loading scipy's linear algebra, which takes a third of the CPU of a process's first kernel call.

    numba loads it with its array functions even if no kernel multiplies matrices. Our kernels do not. A kernel that
    did would fail to compile. Call this before the first kernel runs.
    """
    from numba.np import linalg

    def refuse() -> None:
        raise ImportError("instant_ic.util.jit leaves out scipy's linear algebra: write the sums out")

    linalg.ensure_blas = refuse
