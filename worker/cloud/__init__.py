"""Point clouds: arrays, poses, voxels, normals, tiles and file formats; knows nothing above it."""
