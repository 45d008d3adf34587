"""Triangles, and what voxels hold of them."""
