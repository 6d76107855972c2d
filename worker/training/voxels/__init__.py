"""Training of the voxel network: samples of evidence with labels, the loop, and the card of what comes of it."""
