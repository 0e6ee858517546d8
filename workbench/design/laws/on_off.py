"""Modal on-off control: a relay with a dead band per controlled mode; the actuators share the modal forces.

Meirovitch, VanLandingham & Öz (1977), reference [77] of the dissertation: f_r = -k_r sgn(s_r) outside a dead band of
s_r = q_r' + λ_r q_r, and F = B⁺ f on the actuators.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from workbench.design.laws.law import DesignError, controlled_indices, participation
from workbench.renamed import Renamed
from workbench.rig.actuators import Actuator
from workbench.structure.modes import Modes, freeze


@dataclass(frozen=True)
class Relay:
    """An on-off force on one mode.

    Attributes:
        omega: ω of the mode, rad/s.
        damping: c = 2 ζ ω, 1/s.
        force: k > 0, modal.
        dead_band: d >= 0, of s.
        slope: λ >= 0 of s = q' + λ q, 1/s; 0 switches on the rate alone.
    """

    omega: float
    damping: float
    force: float
    dead_band: float
    slope: float = 0.0


@dataclass(frozen=True, eq=False)
class OnOffLaw:
    """A relay on every controlled mode.

    Attributes:
        relays: one per controlled mode.
        allocation: (n_actuators, n_controlled) B⁺, from modal forces to actuator forces.
        controlled: (n_controlled,) zero-based indices.
        actuators: (n_actuators,) driven by the law.
        name: for tables and plots.
        designed_by: as of a `Law`.
    """

    relays: tuple[Relay, ...]
    allocation: np.ndarray
    controlled: tuple[int, ...]
    actuators: tuple[Actuator, ...]
    name: str = "on-off"
    designed_by: Callable[[Modes, Sequence[int], Sequence[Actuator]], "OnOffLaw"] | None = None

    spread = Renamed("allocation")

    def __post_init__(self) -> None:
        freeze(self, "allocation")


def on_off(
    modes: Modes,
    controlled: int | Sequence[int],
    actuators: Sequence[Actuator],
    *,
    force: ArrayLike,
    dead_band: ArrayLike,
    slope: ArrayLike = 0.0,
) -> OnOffLaw:
    """Modal on-off control with a dead band.

    Args:
        modes, controlled, actuators: as for `imsc`.
        force: k, modal force, scalar or (n_controlled,), positive.
        dead_band: d of s = q' + λ q, likewise, not negative. Where λ = 0, an undamped mode keeps at most ½ d² of
            energy.
        slope: λ, 1/s, likewise, not negative.

    Raises:
        DesignError: damping that couples the modes, or values out of range.
    """
    index = controlled_indices(modes, controlled)
    if not modes.proportional:
        raise DesignError(
            "damping couples the modes, so they cannot be switched one by one; neglect its coupling terms"
        )
    n = len(index)
    values = []
    for name, value in (("force", force), ("dead_band", dead_band), ("slope", slope)):
        value = np.asarray(value, float)
        if value.shape not in ((), (1,), (n,)):
            raise DesignError(f"on-off {name} is one number, or one per controlled mode, {n}; got {value.size}")
        value = np.broadcast_to(value, n)
        if not np.isfinite(value).all() or (value < 0).any() or (name == "force" and not value.all()):
            least = "positive" if name == "force" else "0 or more"
            raise DesignError(f"on-off {name} must be {least}; got {value.min():g}")
        values.append(value)
    own = list(index)
    rows = zip(modes.omega[own], np.diag(modes.damping)[own], *values, strict=True)
    relays = tuple(Relay(*map(float, row)) for row in rows)
    allocation = np.linalg.pinv(participation(modes, index, actuators))
    again = partial(on_off, force=force, dead_band=dead_band, slope=slope)
    return OnOffLaw(relays, allocation, index, tuple(actuators), designed_by=again)
