"""Stabilisation diagrams: a physical mode is stable over the model order.

It appears at every order, with the same frequency and a shape that is real but for its scale; poles that only fit the
noise, or small inconsistencies between points measured one after the other, change with the order or are complex.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from workbench.identification.free_decay.ibrahim import as_modes, shift_eigenpairs, signal_subspace
from workbench.identification.signal.data_quality import check_same_sensors
from workbench.records.record import Record
from workbench.structure.modes import SampledModes, mac


@dataclass(frozen=True, eq=False)
class Stabilisation:
    """The modes identified at each order, from the lowest to the highest.

    Attributes:
        orders: numbers of modes asked for.
        found: the `SampledModes` of each.
    """

    orders: tuple[int, ...]
    found: tuple[SampledModes, ...]


@dataclass(frozen=True, eq=False)
class StableModes:
    """The stable modes of a diagram.

    Attributes:
        modes: each as identified at the order where its phase collinearity is highest.
        presence: (n_modes,) share of the orders at which it was found.
        frequency_spread: (n_modes,) standard deviation of its frequency over the orders, relative.
    """

    modes: SampledModes
    presence: np.ndarray
    frequency_spread: np.ndarray


def stabilise(records: Record | Sequence[Record], *, orders: Sequence[int], delays: int | None = None) -> Stabilisation:
    """Identify at several orders from one subspace.

    Args:
        records: free decay of the same sensors.
        orders: numbers of modes, increasing.
        delays: as in `stacked_delays`.

    Raises:
        ValueError: fewer samples than the highest order needs.
    """
    records = [records] if isinstance(records, Record) else list(records)
    check_same_sensors(records)
    basis = signal_subspace(records, 2 * max(orders), delays=delays)
    found = []
    for n in orders:
        mu, shapes = shift_eigenpairs(basis[:, : 2 * n], records[0].n_outputs)
        found.append(as_modes(mu, shapes, records[0]))
    return Stabilisation(tuple(orders), tuple(found))


def stable_modes(
    diagram: Stabilisation,
    *,
    frequency: float = 0.02,
    shape: float = 0.8,
    standing: float = 0.8,
    presence: float = 0.5,
    largest_damping: float = 0.2,
) -> StableModes:
    """The modes that are stable over the orders of a diagram.

    Args:
        diagram: from `stabilise`.
        frequency: relative difference up to which two poles are one mode.
        shape: MAC from which on they are.
        standing: least phase collinearity of a shape.
        presence: least share of the orders.
        largest_damping: ratios above are noise, as are negative ones.
    """
    groups: list[list[tuple[SampledModes, int]]] = []
    for modes in diagram.found:
        keep = (modes.zeta > 0) & (modes.zeta < largest_damping) & (modes.phase_collinearity >= standing)
        taken = set()
        # The most collinear shapes choose first, so that a split of a mode does not take its place.
        for r in sorted(np.flatnonzero(keep), key=lambda r: -modes.phase_collinearity[r]):
            near = _nearest(groups, modes, int(r), frequency, shape)
            if near is None:
                groups.append([(modes, int(r))])
                taken.add(len(groups) - 1)
            elif near not in taken:
                groups[near].append((modes, int(r)))
                taken.add(near)
    stayed = [g for g in groups if len(g) >= presence * len(diagram.orders)]
    best = [max(g, key=lambda item: item[0].phase_collinearity[item[1]]) for g in stayed]
    order = np.argsort([modes.omega[r] for modes, r in best])
    best, stayed = [best[i] for i in order], [stayed[i] for i in order]
    positions = diagram.found[0].positions
    modes = SampledModes(
        np.array([m.omega[r] for m, r in best]),
        np.array([m.zeta[r] for m, r in best]),
        np.array([m.shapes[:, r] for m, r in best]).reshape(len(best), positions.size).T,
        positions,
    )
    spread = np.array([np.std([m.omega[r] for m, r in g]) for g in stayed]) / np.maximum(modes.omega, 1e-300)
    return StableModes(modes, np.array([len(g) for g in stayed]) / len(diagram.orders), spread)


def _nearest(
    groups: list[list[tuple[SampledModes, int]]], modes: SampledModes, r: int, frequency: float, shape: float
) -> int | None:
    """The group whose last member is this mode, if any."""
    nearest, distance = None, frequency
    for i, group in enumerate(groups):
        last, k = group[-1]
        apart = abs(modes.omega[r] / last.omega[k] - 1.0)
        if apart <= distance and mac(modes.shapes[:, [r]], last.shapes[:, [k]])[0, 0] >= shape:
            nearest, distance = i, apart
    return nearest
