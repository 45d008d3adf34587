"""Points with values, and their sums in voxels of any size."""
