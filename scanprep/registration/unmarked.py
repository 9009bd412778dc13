"""Registration without landmarks: by correspondences that are found, and by the ends of limbs where one was lost."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..correspondence.correlated import find_correspondences, find_seeds
from ..correspondence.correspondences import Correspondences
from ..correspondence.search import CorrelatedConfig
from ..geometry.mesh import Mesh
from .nonrigid import Registration, near_origin, register
from .schedule import RegistrationConfig


@near_origin
def register_unmarked(template: Mesh, scan: Mesh | np.ndarray, config: RegistrationConfig | None = None,
                      search: CorrelatedConfig | None = None, progress: Callable[[int, int], None] | None = None
                      ) -> tuple[Registration, Correspondences]:
    """Bring a template onto a scan that has no landmarks; and the correspondences that led it.

    Correspondences that are sure may leave out a limb, a forearm bent upwards, say, which then stays beside its scan.
    A scan that is not all covered is registered again with the ends of its limbs as landmarks, and the registration
    that covers more is kept. ValueError as from `find_correspondences` and `register`.
    """
    seeds = find_seeds(template, scan)
    ends = seeds.template_vertices, seeds.scan_points
    pairs = find_correspondences(template, scan, ends, search)
    fit = register(template, scan, None, config, progress, pairs)
    if fit.uncovered > 0.005:                      # as a share of the scan: a limb may be lost
        again = register(template, scan, ends, config, progress, pairs)
        if again.uncovered < fit.uncovered:
            fit = replace(again, landmark_rms=np.nan)                # nobody clicked them
    return fit, pairs
