"""Impact zones: what contacts could not keep apart moves as one for a substep."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


class ImpactZones:
    """Groups of vertices that get their mean displacement (Provot 1997; without rotation).

    Nothing in a zone can cross, as a common translation leaves all distances as they are; and as a zone grows whenever
    one of its vertices takes part in another crossing, the rounds end. Linear momentum is kept, angular momentum but
    for the spin of the zone. Pinned vertices keep their displacement, and a zone that holds some follows their mean.

    Args:
        mass: of all vertices [kg], (n,).
        pinned: which of them are pinned, (n,) bool.
    """

    def __init__(self, mass: NDArray[np.float32], pinned: NDArray[np.bool_]) -> None:
        self._mass, self._pinned = mass.astype(np.float64), pinned
        self._links: list[NDArray[np.int64]] = []
        self.labels = np.arange(len(mass))

    def join(self, crossing: NDArray[np.int32]) -> bool:
        """Put the four vertices of each crossing pair into one zone; whether any zone grew.

        Args:
            crossing: vertices of the pairs, (m, 4).
        """
        n = len(self._mass)
        quadruples = crossing.astype(np.int64)
        self._links += [np.stack([quadruples[:, 0], quadruples[:, k]], axis=1) for k in (1, 2, 3)]
        links = np.unique(np.concatenate(self._links), axis=0)
        graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(n, n))
        count, labels = connected_components(graph, directed=False)
        grew = count < len(np.unique(self.labels))
        self.labels = labels
        return grew

    @property
    def members(self) -> NDArray[np.int64]:
        """Vertices that share their zone with others, in ascending order, (k,)."""
        return np.flatnonzero(np.bincount(self.labels)[self.labels] > 1)

    def apply(self, displacement: NDArray[np.float32]) -> NDArray[np.float32]:
        """The displacements [m], (n, 3), with that of each zone for its free vertices."""
        members = self.members
        zone = self.labels[members]
        held = np.bincount(zone, self._pinned[members], minlength=len(self._mass))[zone] > 0.0
        weight = np.where(held, self._pinned[members].astype(np.float64), self._mass[members])
        total = np.bincount(zone, weight, minlength=len(self._mass))
        result = displacement.copy()
        free = ~self._pinned[members]
        for axis in range(3):
            moment = np.bincount(zone, weight * displacement[members, axis], minlength=len(self._mass))
            result[members[free], axis] = (moment[zone] / total[zone])[free].astype(np.float32)
        return result
