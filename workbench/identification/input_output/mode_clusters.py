"""Modes that are told as several and are one.

Points measured one after another disagree: a moved sensor loads the structure elsewhere, a harder blow rings lower. A
mode that depends on its amplitude has a skew peak. Modes that all outputs share can follow either only by crowding:
three and more of them within each other's half-power bands, with shapes that swing in no common phase. One alone then
tells what is known.
"""

import numpy as np

# Modes of one structure may overlap in twos; damping couples more of them only by swinging out of phase.
FEWEST, IN_PHASE = 3, 0.95
NARROW = 3.0  # half-power bands of the strongest: broader ones lead to no further parts


def parts_of(poles: np.ndarray, collinearity: np.ndarray, strength: np.ndarray) -> dict[int, list[int]]:
    """The modes that stand for a crowd, each with its parts; those that stand for themselves alone are absent.

    Args:
        poles: (n_modes,) rad/s.
        collinearity: (n_modes,) modal phase collinearity, 1 where all points swing together.
        strength: (n_modes,) the strongest of a crowd stands for it.
    """
    width = np.abs(poles.real)
    near = np.abs(np.subtract.outer(poles.imag, poles.imag)) < width[:, None] + width
    left, crowds = list(np.argsort(-strength)), dict[int, list[int]]()
    while left:
        first = left.pop(0)
        crowd, leads = [int(first)], [first]
        while leads:
            lead = leads.pop()
            met = [r for r in left if near[r, lead]]
            left = [r for r in left if r not in met]
            crowd += [int(r) for r in met]
            leads += [r for r in met if width[r] < NARROW * width[first]]
        if len(crowd) >= FEWEST and collinearity[crowd].min() < IN_PHASE:
            crowds[crowd[0]] = crowd[1:]
    return crowds
