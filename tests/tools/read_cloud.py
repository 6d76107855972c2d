"""Reads a PLY with MeshLab's own library, and prints the number of each point as JSON; runs in build/tools."""

from __future__ import annotations

import json
import math
import sys

import pymeshlab

if __name__ == "__main__":
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.load_new_mesh(sys.argv[1])
    mesh = meshes.current_mesh()
    quality = mesh.vertex_scalar_array().tolist() if mesh.has_vertex_scalar() else None
    shown = quality and [None if math.isnan(value) else value for value in quality]
    print(json.dumps({"points": mesh.vertex_number(), "quality": shown}))
