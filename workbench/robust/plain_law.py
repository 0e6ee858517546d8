"""A law from one number: the damping that its controlled modes should have."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from workbench.design.laws.coupled import coupled_lqr, coupled_poles
from workbench.design.laws.imsc import imsc
from workbench.design.laws.law import DesignError, Law, controlled_indices
from workbench.design.laws.on_off import OnOffLaw, on_off
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.statespace import input_matrix
from workbench.structure.domain import Where
from workbench.structure.modes import Modes

PERIODS = 5.0  # in which on-off control stops each mode
BAND = 0.02  # of the first speed: the dead band of on-off control


def plain_law(
    kind: str,
    rig: Rig,
    controlled: int | Sequence[int] | None = None,
    *,
    damping: float = 0.1,
    impulse_at: Where | None = None,
    impulse: float = 1.0,
) -> Law | OnOffLaw:
    """A law of a kind with settings by a rule of thumb.

    IMSC: R = 1 / (2 ζ² ω²) a mode; coupled LQR the mean of that times b_r b_rᵀ; poles: -ζ ω ± i ω √(1 - ζ²); on-off:
    forces that stop each mode within five periods after the impulse, and a dead band of a fiftieth of its first speed.

    Args:
        kind: "imsc", "coupled", "poles" or "on-off".
        rig: whose actuators drive it, hammers left out.
        controlled: how many of the lowest modes, or which; as many as actuators unless given.
        damping: ζ wanted of controlled modes: poles give it, the weights of IMSC and coupled LQR come near it where it
            is small; on-off control takes none.
        impulse_at, impulse: for which on-off forces are sized, N s; by the first actuator itself unless given.

    Raises:
        DesignError: an unknown kind, no actuator, or a damping ratio out of range.
    """
    actuators = [a for a in rig.actuators if not a.direct]
    if not actuators:
        raise DesignError("the rig has no actuator to control with, only measured forces; add one")
    if not 0 < damping < 1:
        raise DesignError(f"the damping ratio of controlled modes must lie between 0 and 1; got {damping:g}")
    if kind not in KINDS:
        raise DesignError(f"no law is called {kind!r}; the laws are {', '.join(KINDS)}")
    modes = rig.modes
    index = controlled_indices(modes, len(actuators) if controlled is None else controlled)
    if (modes.omega[list(index)] == 0).any():
        raise DesignError("a rigid mode has no damping ratio; design its law with a weight or poles of your own")
    if kind == "on-off":
        shape = struck_by(modes, actuators[0]) if impulse_at is None else modes.phi_at(impulse_at)
        return _on_off(modes, index, actuators, np.abs(impulse * shape[list(index)]))
    return LINEAR[kind](modes, index, actuators, damping)


def struck_by(modes: Modes, actuator: Actuator) -> np.ndarray:
    """Modal forces (n_modes,) of a unit force, or moment, by an actuator without losses and a gain of 1."""
    return input_matrix(modes, [replace(actuator, gain=1.0)])[:, 0]


Rule = Callable[[Modes, tuple[int, ...], list[Actuator], float], Law]


def _imsc(modes: Modes, index: tuple[int, ...], actuators: list[Actuator], ratio: float) -> Law:
    return imsc(modes, index, actuators, weight=0.5 / (ratio * modes.omega[list(index)]) ** 2)


def _coupled(modes: Modes, index: tuple[int, ...], actuators: list[Actuator], ratio: float) -> Law:
    reach = (input_matrix(modes, actuators)[list(index)] ** 2).sum(axis=1)
    return coupled_lqr(
        modes, index, actuators, weight=float(np.mean(0.5 * reach / (ratio * modes.omega[list(index)]) ** 2))
    )


def _poles(modes: Modes, index: tuple[int, ...], actuators: list[Actuator], ratio: float) -> Law:
    poles = modes.omega[list(index)] * (-ratio + 1j * np.sqrt(1.0 - ratio**2))
    return coupled_poles(modes, index, actuators, poles=poles)


def _on_off(modes: Modes, index: tuple[int, ...], actuators: list[Actuator], speed: np.ndarray) -> OnOffLaw:
    speed = np.maximum(speed, 0.1 * speed.max())
    # each period takes 4 k / ω² from the amplitude q'/ω
    force = speed * modes.omega[list(index)] / (4.0 * PERIODS)
    return on_off(modes, index, actuators, force=force, dead_band=BAND * speed)


LINEAR: Mapping[str, Rule] = {"imsc": _imsc, "coupled": _coupled, "poles": _poles}
KINDS = (*LINEAR, "on-off")
