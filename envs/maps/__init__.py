"""Maps: point clouds, their checks, rasters and navigation grids, and batches of them for the kernels."""
