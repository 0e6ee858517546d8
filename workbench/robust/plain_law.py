"""A law by a rule of thumb, from the damping wanted of its controlled modes."""

from collections.abc import Sequence

import numpy as np

from workbench.design.laws.coupled import coupled_lqr, coupled_poles
from workbench.design.laws.imsc import imsc
from workbench.design.laws.law import DesignError, Law, controlled_indices
from workbench.design.laws.on_off import OnOffLaw, on_off
from workbench.rig.actuators import without_crosstalk
from workbench.rig.rig import Rig
from workbench.rig.statespace import input_matrix
from workbench.robust.impulse import impulse_speeds
from workbench.structure.domain import Location

KINDS = ("imsc", "coupled", "poles", "on-off")
PERIODS = 5.0  # within which on-off control stops each mode
BAND = 0.02  # dead band of on-off control over the initial modal speed


def plain_law(
    kind: str,
    rig: Rig,
    controlled: int | Sequence[int] | None = None,
    *,
    damping: float = 0.1,
    impulse_at: Location | None = None,
    impulse: float = 1.0,
) -> Law | OnOffLaw:
    """A law of a kind with settings by a rule of thumb.

    IMSC: R = 1 / (2 ζ² ω²) per mode; coupled LQR the mean of that times b_r b_rᵀ; poles: -ζ ω ± i ω √(1 - ζ²); on-off:
    forces that stop each mode within five periods after the impulse, and a dead band of 2 % of its initial speed.

    Args:
        kind: "imsc", "coupled", "poles" or "on-off".
        rig: its actuators, without hammers, are those of the law.
        controlled: number of the lowest modes, or their indices (zero-based); by default as many as actuators.
        damping: ζ wanted of controlled modes: exact for poles, approximate for small ζ for IMSC and coupled LQR, not
            used for on-off control.
        impulse_at, impulse: impulse (N s) for which on-off forces are sized; by default by the first actuator.

    Raises:
        DesignError: an unknown kind, no actuator, or a damping ratio out of range.
    """
    actuators = without_crosstalk([a for a in rig.actuators if not a.direct])
    if not actuators:
        raise DesignError("the rig has no actuator to control with, only measured forces; add one")
    if not 0 < damping < 1:
        raise DesignError(f"the damping ratio of controlled modes must lie between 0 and 1; got {damping:g}")
    if kind not in KINDS:
        raise DesignError(f"no law is called {kind!r}; the laws are {', '.join(KINDS)}")
    modes = rig.modes
    index = controlled_indices(modes, len(actuators) if controlled is None else controlled)
    omega = modes.omega[list(index)]
    if (omega == 0).any():
        raise DesignError("a rigid mode has no damping ratio; design its law with a given weight or poles")
    if kind == "imsc":
        return imsc(modes, index, actuators, weight=0.5 / (damping * omega) ** 2)
    if kind == "coupled":
        squared = (input_matrix(modes, actuators)[list(index)] ** 2).sum(axis=1)
        return coupled_lqr(modes, index, actuators, weight=float(np.mean(0.5 * squared / (damping * omega) ** 2)))
    if kind == "poles":
        return coupled_poles(modes, index, actuators, poles=omega * (-damping + 1j * np.sqrt(1.0 - damping**2)))
    speed = impulse_speeds(modes, list(index), impulse, impulse_at, actuators[0])
    # a relay reduces the amplitude q'/ω by 4 k / ω² per period
    return on_off(modes, index, actuators, force=speed * omega / (4.0 * PERIODS), dead_band=BAND * speed)
