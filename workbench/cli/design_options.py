"""The rig, the places and the controller that the options of the design commands name."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from workbench.cli.options import DAMPING, ESTIMATORS
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig, derivative_of
from workbench.structure.domain import Between, Domain, Interval, Location, NamedPoints, Patch, Place, PlaceError

if TYPE_CHECKING:
    from workbench.design.estimation.controller import Controller
    from workbench.design.laws.law import Law
    from workbench.design.laws.on_off import OnOffLaw
    from workbench.records.units import Units
    from workbench.structure.modes import Modes


def read_rig_and_units(path: Path) -> "tuple[Rig, Units]":
    """The rig and the units of a TOML file, or of case.toml in a case folder."""
    from workbench.cases.case import read_units
    from workbench.cases.nominal import read_rig

    file = path / "case.toml" if path.is_dir() else path
    return read_rig(file), read_units(file)


def read_structure_rig(path: Path) -> "tuple[Rig, Units]":
    """As `read_rig_and_units`, with an actuator at a node moved to the point of its direction.

    Modal data whose shapes are known at the inputs and outputs alone, or a damping ratio of 1 or more, are refused.
    """
    found, units = read_rig_and_units(path)
    elastic = found.modes.zeta[found.modes.omega > 0]
    if (elastic >= 1.0).any():
        raise ValueError(
            f"{path}: a damping ratio is a share of critical damping, below 1, such as 0.02 for 2 %; got"
            f" {elastic.max():g}"
        )
    domain = found.modes.domain
    if not isinstance(domain, NamedPoints):
        return found, units
    if domain.positions is None:
        raise ValueError(
            f'{path}: plain modal data have no shapes between points; name a file of points (points = "points.csv"), or'
            " describe a beam, a rod or a plate"
        )

    def at_point(a: Actuator) -> Actuator:
        return replace(a, at=domain.slope(a.at, derivative_of(a), a.direction)[0][0], direction=None)

    actuators = tuple(at_point(a) if isinstance(a.at, str) else a for a in found.actuators)
    return replace(found, actuators=actuators), units


def typed_place(domain: Domain, text: str, option: str) -> Place:
    """The place of a text: a position in m along a beam, X,Y on a plate, or the name of a point."""
    if isinstance(domain, NamedPoints):
        return text.strip()
    form = "a position in m, such as 0.4" if isinstance(domain, Interval) else "X,Y in m, such as 0.4,0.25"
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != (1 if isinstance(domain, Interval) else 2):
        raise ValueError(f"{option} takes {form}; got {text!r}")
    return numbers[0] if len(numbers) == 1 else (numbers[0], numbers[1])


def place_in(domain: Domain, text: str, option: str) -> Place:
    """The place of a text, which must be on the structure."""
    at = typed_place(domain, text, option)
    try:
        domain.locate(at)
    except PlaceError as error:
        raise ValueError(f"{option}: {error}") from None
    return at


def impulse_place(rig: Rig, at: str | None) -> Place:
    """The place of the impulse: as given, by place or by input, or that of the rig's hammer."""
    inputs = {a.name: a.at for a in rig.actuators if not isinstance(a.at, Between | Patch)}
    if at is not None and at.strip() in inputs:
        return inputs[at.strip()]
    if at is not None:
        try:
            return place_in(rig.modes.domain, at, "--impulse-at")
        except ValueError as error:
            raise ValueError(f"{error}; or name an input: {', '.join(inputs) or 'there is none'}") from None
    hammers = [inputs[a.name] for a in rig.actuators if a.direct and a.name in inputs]
    if not hammers:
        raise ValueError("the place of the impulse is missing: give --impulse-at, or an [[input]] of kind hammer")
    return hammers[0]


def check_rate(rate_hz: float | None) -> None:
    """Refuse a sample rate of the controller that is not positive and finite, by a `ValueError`."""
    if rate_hz is not None and not 0 < rate_hz < float("inf"):
        raise ValueError(f"--rate-hz is the sample rate of the controller, above 0 Hz; got {rate_hz:g}")


def count_of(rig: Rig, control: int | None) -> int:
    """The number of controlled modes: as given, or that of the actuators, at least 1."""
    return max(sum(not a.direct for a in rig.actuators), 1) if control is None else control


def law_from(
    rig: Rig,
    law: str,
    count: int,
    weight: float | None,
    damping: float | None,
    *,
    impulse_at: Location | None = None,
    impulse: float = 1.0,
) -> "Law | OnOffLaw":
    """The law of this name, with a weight or a damping ratio; both, or one that the law has not, is refused."""
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
    found = [f"{-100.0 * p.real / abs(p):.3g} %" for p in oscillating]
    if (modes.omega[list(law.controlled)] == 0).any():
        found.append("none of rigid modes")
    ratios = ", ".join(found) or "100 % or more"
    return f"damping ratio of the controlled modes by {law.name}, with exact modal coordinates: {ratios}"


def observed(
    rig: Rig, law: "Law | OnOffLaw", estimator: str, *, disturbance: float, sample_time: float
) -> "Controller":
    """The law with an observer of all displacements and velocities, or a modal filter of places that have both."""
    from workbench.design.estimation.controller import filtered
    from workbench.design.estimation.modal_filter import filter_on
    from workbench.design.estimation.observers import kalman_controller, luenberger_controller, usual_poles
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
        return luenberger_controller(rig.modes, law, sensors, poles=usual_poles(rig.modes, law.controlled))
    # a noise of variance σ² held over each sample has the intensity σ² T
    silent = [s.name for s in sensors if s.noise_std == 0]
    if silent:
        raise ValueError(
            f"a Kalman filter needs the noise of the outputs, and noise_std of {', '.join(silent)} is 0: give it in the"
            " case file, or choose --estimator luenberger"
        )
    noise = [s.noise_std**2 * sample_time for s in sensors]
    return kalman_controller(rig.modes, law, sensors, disturbance=disturbance, noise=noise)
