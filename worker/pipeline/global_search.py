"""Where a scan is when nobody knows: candidate poses from local descriptors, without any start.

KISS-Matcher (Lim et al., ICRA 2025; MIT licence) matches FPFH-like descriptors and rejects outliers through
the consistency of pairs, so it needs no random draws; our several "seeds" are several resolutions. On the real
pairs in our tests each resolution ends in ICP's basin (0.05 to 0.5 s); see docs/decisions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import kiss_matcher
import numpy as np

from worker.pipeline.values import Floats, Matrix4


def candidate_poses(source: Floats, target: Floats, *, resolutions: Sequence[float]) -> Iterator[Matrix4]:
    """Yield target_from_source for each resolution (metres) that finds a consistent set of matches.

    Source (N, 3) and target (M, 3), metres. The candidates are rough (decimetres, degrees) and may be wrong:
    refine and verify them.
    """
    for resolution in resolutions:
        matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(resolution))
        found = matcher.estimate(source, target)
        if not found.valid:
            continue
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = found.rotation, found.translation
        yield pose
