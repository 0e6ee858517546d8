"""Clusters of identified modes that are one mode of the structure.

Points measured one after another are inconsistent: a roving sensor loads the structure elsewhere, a harder hit rings
lower. A mode that depends on its amplitude has a skew peak. A linear model fits either only by a cluster: three and
more modes within each other's half-power bands, with complex shapes of no common phase. Only one is then reported.
"""

import numpy as np

# Two modes of one structure may overlap; shapes of more than two do so only where damping makes them complex.
FEWEST, IN_PHASE = 3, 0.95
NARROW = 3.0  # half-power bands of the strongest: broader ones do not extend the cluster


def parts_of(poles: np.ndarray, collinearity: np.ndarray, strength: np.ndarray) -> dict[int, list[int]]:
    """The representative of each cluster, with its other members; modes in no cluster are absent.

    Args:
        poles: (n_modes,) rad/s.
        collinearity: (n_modes,) modal phase collinearity, 1 where all points move in phase.
        strength: (n_modes,) the strongest of a cluster represents it.
    """
    width = np.abs(poles.real)
    near = np.abs(np.subtract.outer(poles.imag, poles.imag)) < width[:, None] + width
    left, clusters = list(np.argsort(-strength)), dict[int, list[int]]()
    while left:
        first = left.pop(0)
        cluster, leads = [int(first)], [first]
        while leads:
            lead = leads.pop()
            met = [r for r in left if near[r, lead]]
            left = [r for r in left if r not in met]
            cluster += [int(r) for r in met]
            leads += [r for r in met if width[r] < NARROW * width[first]]
        if len(cluster) >= FEWEST and collinearity[cluster].min() < IN_PHASE:
            clusters[cluster[0]] = cluster[1:]
    return clusters


def overlap_remarks(poles: np.ndarray, n_channels: int) -> tuple[str, ...]:
    """A remark on modes within each other's half-power bands that one pair of input and output cannot distinguish.

    Args:
        poles: (n_modes,) rad/s, by rising frequency.
        n_channels: outputs times inputs; two and more distinguish modes by their shapes.
    """
    width = np.abs(poles.real)
    near = np.abs(np.subtract.outer(poles.imag, poles.imag)) < width[:, None] + width
    first, second = np.nonzero(np.triu(near, 1))
    if n_channels > 1 or not first.size:
        return ()
    pairs = ", ".join(f"{r + 1} and {s + 1}" for r, s in zip(first, second, strict=True))
    return (
        f"modes {pairs} overlap: one mode that drifts or depends on amplitude looks like that to a single input and"
        " output; compare parts of the record, or measure at another place",
    )
