"""Reads files of features with GeoPandas, and prints what it sees as JSON; runs in build/tools."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import geopandas


def seen(path: Path) -> dict[str, Any]:
    """What GeoPandas makes of a file."""
    try:
        frame = geopandas.read_file(path)
    except Exception as error:  # it is the answer that the test wants
        return {"error": f"{type(error).__name__}: {error}"}
    lies = isinstance(frame, geopandas.GeoDataFrame) and frame.geometry.notna().any()
    crs = frame.crs if isinstance(frame, geopandas.GeoDataFrame) else None
    return {
        "rows": len(frame),
        "columns": {name: str(kind) for name, kind in frame.dtypes.items()},
        "crs": None if crs is None else crs.to_string(),
        "geographic": crs is not None and crs.is_geographic,
        "bounds": [float(number) for number in frame.total_bounds] if lies else None,
        "z": [float(frame[name].iloc[0]) for name in ("z_min", "z_max")] if "z_min" in frame else None,
    }


if __name__ == "__main__":
    print(json.dumps([seen(Path(path)) for path in sys.argv[1:]]))
