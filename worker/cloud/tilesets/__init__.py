"""3D Tiles 1.1 of points: nested samples of a cloud, as GLB, for viewers that load what the eye can tell apart."""
