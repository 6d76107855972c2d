"""Reads files of features with QGIS's own library, and prints what it sees as JSON; runs where QGIS is installed."""

from __future__ import annotations

import json
import sys

from qgis.core import QgsApplication, QgsVectorLayer

if __name__ == "__main__":
    QgsApplication.setPrefixPath("/usr", True)
    app = QgsApplication([], False)
    app.initQgis()
    told = []
    for path in sys.argv[1:]:
        layer = QgsVectorLayer(path, "features", "ogr")
        box = layer.extent()
        told.append(
            {
                "valid": layer.isValid(),
                "count": layer.featureCount(),
                "fields": [field.name() for field in layer.fields()],
                "geographic": layer.crs().isValid() and layer.crs().isGeographic(),
                "bounds": [box.xMinimum(), box.yMinimum(), box.xMaximum(), box.yMaximum()],
            }
        )
    print(json.dumps(told))
    del layer
    app.exitQgis()
