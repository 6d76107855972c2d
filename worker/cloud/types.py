"""The array types that every stage speaks."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float32]  #: (N, 3) metres
Colors = NDArray[np.uint8]  #: (N, 3) red, green, blue
Normals = NDArray[np.float32]  #: (N, 3) unit length
Matrix4 = NDArray[np.float64]  #: (4, 4) rigid, target_from_source
Indices = NDArray[np.int32]  #: (T, 3) tile indices i, j, k
Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]
Arrays = dict[str, NDArray[Any]]  #: named arrays, as an .npz file holds them
