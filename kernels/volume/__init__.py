"""Warp kernels of volumes: voxels as bits, beside those of the plane."""
