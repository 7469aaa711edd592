"""The hash-grid field: kernels in numba and Triton, and the plain torch reference for their tests."""
