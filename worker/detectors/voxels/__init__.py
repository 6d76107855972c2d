"""What the detectors by voxels share: evidence from both visits, and tiles made of voxels' probabilities."""
