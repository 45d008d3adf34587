"""Points with values: what voxels of any size hold of them."""
