"""The voxel network: a sparse U-Net on the evidence of both visits, one for both directions."""
