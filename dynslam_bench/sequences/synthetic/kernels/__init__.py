"""The renderer's compiled kernels and its two sensors."""
