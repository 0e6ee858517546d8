"""The controller of the options of `export` and `redesign`: law, modes and estimator."""

from dataclasses import replace
from typing import TYPE_CHECKING

from workbench.cli.options import DAMPING, ESTIMATORS

if TYPE_CHECKING:
    from workbench.design.estimation.controller import Controller
    from workbench.design.laws.law import Law
    from workbench.design.laws.on_off import OnOffLaw
    from workbench.rig.rig import Rig
    from workbench.structure.domain import Where
    from workbench.structure.modes import Modes


def check_rate(rate_hz: float | None) -> None:
    """Refuse an invalid sample rate of the controller.

    Raises:
        ValueError: a rate that is not positive and finite.
    """
    if rate_hz is not None and not 0 < rate_hz < float("inf"):
        raise ValueError(f"--rate-hz is the sample rate of the controller, above 0 Hz; got {rate_hz:g}")


def count_of(rig: "Rig", control: int | None) -> int:
    """The number of controlled modes: as given, or that of the actuators, at least 1."""
    return max(sum(not a.direct for a in rig.actuators), 1) if control is None else control


def law_from(
    rig: "Rig",
    law: str,
    count: int,
    weight: float | None,
    damping: float | None,
    *,
    impulse_at: "Where | None" = None,
    impulse: float = 1.0,
) -> "Law | OnOffLaw":
    """The law of this name, with a weight or a damping ratio.

    Raises:
        ValueError: both are given, or the law has no weight or no damping ratio.
    """
    from workbench.design.laws.coupled import coupled_lqr
    from workbench.design.laws.imsc import imsc
    from workbench.robust.plain_law import plain_law

    if damping is not None and law == "on-off":
        raise ValueError("on-off control gives no damping ratio; leave --damping out")
    if weight is None:
        ratio = DAMPING if damping is None else damping
        return plain_law(law, rig, count, damping=ratio, impulse_at=impulse_at, impulse=impulse)
    if damping is not None:
        raise ValueError("--weight and --damping both set the gain; give one of them")
    if law not in (weighted := {"imsc": imsc, "coupled": coupled_lqr}):
        raise ValueError(f"--weight is for the laws {', '.join(weighted)}; give --damping for {law}")
    return weighted[law](rig.modes, count, [a for a in rig.actuators if not a.direct], weight=weight)


def damping_by(modes: "Modes", law: "Law | OnOffLaw") -> str:
    """A sentence on the damping ratios of the controlled modes, which may differ from --damping for IMSC and LQR."""
    import numpy as np

    from workbench.design.laws.coupled import controlled_plant
    from workbench.design.laws.law import Law

    if not isinstance(law, Law):
        return f"{law.name} switches and gives no damping ratio"
    a, b = controlled_plant(modes, law.controlled, law.actuators)
    poles = np.linalg.eigvals(a - b @ law.gain)
    oscillating = sorted(poles[poles.imag > 0], key=abs)
    found = [f"{-p.real / abs(p):.3g}" for p in oscillating]
    if (modes.omega[list(law.controlled)] == 0).any():
        found.append("none of rigid modes")
    ratios = ", ".join(found) or "1 or more"
    return f"damping ratio of the controlled modes by {law.name}, with exact modal coordinates: {ratios}"


def observed(
    rig: "Rig", law: "Law | OnOffLaw", estimator: str, *, disturbance: float, sample_time: float
) -> "Controller":
    """The law with an observer of all displacements and velocities, or a modal filter of places that have both.

    Raises:
        ValueError: an unknown estimator, an on-off law, or no such output.
    """
    from workbench.design.estimation.controller import filtered
    from workbench.design.estimation.modal_filter import filter_on
    from workbench.design.estimation.observers import kalman, luenberger, usual_poles
    from workbench.design.laws.law import Law
    from workbench.rig.sensors import MEASURED

    if estimator not in ESTIMATORS:
        raise ValueError(f"--estimator is one of {', '.join(ESTIMATORS)}; got {estimator!r}")
    if not isinstance(law, Law):
        raise ValueError(f"{law.name} takes no --estimator and is exported by `workbench redesign --to`")
    sensors = [s for s in rig.sensors if MEASURED[s.quantity][1] < 2]
    if not sensors:
        raise ValueError(
            "every output is an acceleration, which the observers cannot use; add one of displacement or velocity"
        )
    if estimator == "modal-filter":
        rates = {s.at for s in sensors if s.quantity == "velocity"}
        places = [s.at for s in sensors if s.quantity == "displacement" and s.at in rates]
        if not places:
            raise ValueError(
                "a modal filter needs displacement and velocity at the same places, which no two outputs measure; add"
                " outputs, or choose an observer"
            )
        found = filtered(law, filter_on(rig.structure, rig.modes, law.controlled, places))
        own = [next(s for s in sensors if (s.at, s.quantity) == (one.at, one.quantity)) for one in found.sensors]
        return replace(found, sensors=tuple(own))
    if estimator == "luenberger":
        return luenberger(rig.modes, law, sensors, poles=usual_poles(rig.modes, law.controlled))
    # a noise of variance σ² held over each sample has the intensity σ² T
    silent = [s.name for s in sensors if s.noise_std == 0]
    if silent:
        raise ValueError(
            f"a Kalman filter needs the noise of the outputs, and noise_std of {', '.join(silent)} is 0: give it in the"
            " case file, or choose --estimator luenberger"
        )
    noise = [s.noise_std**2 * sample_time for s in sensors]
    return kalman(rig.modes, law, sensors, disturbance=disturbance, noise=noise)
