"""Many scans in one frame: pairs, pose graph, refinement, fusion."""
