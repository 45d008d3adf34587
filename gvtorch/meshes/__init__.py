"""Triangle meshes, and their voxelization."""
