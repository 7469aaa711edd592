"""The hash-grid field: its kernels in numba, torch and Triton, and the torch reference that they are held to."""
