"""Evaluation of a design of the bench: the closed-loop response of a structure to an impulse."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from scipy.integrate import simpson

from workbench.cases.case import read_units
from workbench.cases.nominal import read_rig
from workbench.design.estimation.controller import filtered
from workbench.design.estimation.modal_filter import ModalFilter, filter_on
from workbench.design.laws.coupled import coupled_lqr
from workbench.design.laws.imsc import imsc
from workbench.design.laws.law import DesignError, Law
from workbench.design.loop.closed_loop import ClosedLoop, Response, close_loop, impulse_state, initial_response
from workbench.design.placement.task import patch_of
from workbench.design.spillover.explain import explain_spillover
from workbench.design.spillover.spillover import Spillover, finite_spillover
from workbench.draw.motion import frame_wireframe
from workbench.records.units import SI, Units
from workbench.rig.actuators import Actuator, command_unit
from workbench.rig.rig import Rig
from workbench.structure.domain import Domain, Interval, NamedPoints, Place, Rectangle, centred_at, middle, reach
from workbench.structure.modes import Modes
from workbench.structure.printed import all_rounded, command_headings, joined_in_words
from workbench.study.runs.cases import StudyError

LAWS = ("IMSC", "coupled LQR")
MOST_TRANSDUCERS = 40
LARGEST = 1e100
N_TIMES, N_FRAMES, N_PLACES, N_CELLS = 2001, 251, 121, 44
MEMBER_WEIGHT, WEIGHT_OMEGA_SQUARED = 20.0, 25.0
SLENDER = 0.03  # least drawn size of a frame in any direction, relative to its largest side
ON_AXIS = 1e-9  # damping ratio below which a pole counts as on the imaginary axis
MOST_GROWTH = 100.0  # e-folds until the final time, above which an unstable loop is refused


@dataclass(frozen=True)
class Design:
    """A design, as it can be changed on the bench.

    Places are x along a member and (x, y) on a plate, in m, or names of points.

    Attributes:
        actuators: places; the centres of piezo patches if the rig has patches.
        sensors: places of displacement sensors whose modal filters feed the law; none for exact modal coordinates.
        controlled: number of controlled modes, lowest first.
        weight: weight R of force for each controlled mode; coupled LQR uses the first.
        law: one of LAWS.
        impulse_at: place of a unit impulse.
        final_time: end of the integration of the work, s.
    """

    actuators: tuple[Place, ...]
    sensors: tuple[Place, ...]
    controlled: int
    weight: tuple[float, ...]
    law: str
    impulse_at: Place
    final_time: float


@dataclass(frozen=True, eq=False)
class DesignResult:
    """The results of a design.

    Attributes:
        response: to the impulse, at N_TIMES instants.
        work: spillover work in every mode, with residual modes initially at rest.
        effort: ∫ FᵀF dt up to the final time.
    """

    law: Law
    loop: ClosedLoop
    response: Response
    work: Spillover
    effort: float


def design_from(content: Mapping[str, Any]) -> Design:
    """A design from JSON.

    Raises:
        StudyError: a value is missing, unknown or not a number.
    """
    names = {field.name for field in fields(Design)}
    if not isinstance(content, Mapping) or set(content) != names:
        raise StudyError(f"a design has {', '.join(sorted(names))}")
    for name in ("actuators", "sensors", "weight"):
        if not isinstance(content[name], list) or len(content[name]) > MOST_TRANSDUCERS:
            raise StudyError(f"{name} is a list of at most {MOST_TRANSDUCERS} entries")
    places = {name: tuple(_place(v, name) for v in content[name]) for name in ("actuators", "sensors")}
    weight, count = tuple(_number(v, "weight") for v in content["weight"]), content["controlled"]
    if not isinstance(count, int) or isinstance(count, bool) or count < 1:
        raise StudyError(f"controlled is the number of controlled modes, at least 1; got {count!r:.40}")
    if content["law"] not in LAWS:
        raise StudyError(f"law is one of {', '.join(LAWS)}; got {content['law']!r:.40}")
    if len(weight) != count or min(weight) <= 0:
        raise StudyError(f"weight is one positive number for each of the {count} controlled modes")
    final_time = _number(content["final_time"], "final_time")
    if final_time <= 0:
        raise StudyError(f"final_time must be positive; got {final_time:g}")
    impulse_at = _place(content["impulse_at"], "impulse_at")
    return Design(**{**content, **places, "weight": weight, "impulse_at": impulse_at, "final_time": final_time})


def _place(value: object, name: str) -> Place:
    """A position, a pair of them, or the name of a point."""
    if isinstance(value, str):
        return value
    if isinstance(value, list | tuple) and len(value) == 2:
        return (_number(value[0], name), _number(value[1], name))
    return _number(value, name)


def _number(value: object, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < LARGEST:
        raise StudyError(f"{name} must be finite numbers; got {value!r:.40}")
    return float(value)


def start(rig: Rig) -> Design:
    """The initial design of a rig: its actuators and hammer, one controlled mode per actuator, and no sensors.

    Raises:
        StudyError: points without positions, or no elastic mode.
    """
    domain = _domain(rig)
    elastic = rig.modes.omega[rig.modes.omega > 0]
    if elastic.size == 0:
        raise StudyError("the structure has no elastic mode; compute more modes")
    places = sorted({middle(a.at) for a in rig.actuators if not a.direct}) or [_share(rig, 0.37)]
    impulse_at = next((a.at for a in rig.actuators if a.direct), _share(rig, 0.63))
    count = min(len(places), rig.modes.n_modes)
    # R ω_1² = 25 gives the first mode of a plate a damping ratio of about 0.14; the weight of a member is from 5.8
    weight = MEMBER_WEIGHT if isinstance(domain, Interval) else float(f"{WEIGHT_OMEGA_SQUARED / elastic[0] ** 2:.3g}")
    return Design(
        tuple(places), (), count, (weight,) * count, LAWS[0], cast(Place, impulse_at), float(2.0 * np.pi / elastic[0])
    )


def _domain(rig: Rig) -> Domain:
    """The domain in which actuators can be moved."""
    domain, kinds = rig.modes.domain, "a beam, a rod or a plate"
    if isinstance(domain, NamedPoints) and domain.positions is None:
        wanted = f"give them in a table of points, or describe the structure as {kinds}"
        raise StudyError(f"points without positions cannot be drawn; {wanted}")
    if not isinstance(domain, NamedPoints) and rig.structure is None:
        raise StudyError(f"the rig has no structure; describe it as {kinds}")
    return domain


def _share(rig: Rig, share: float) -> Place:
    """The place at this fraction of the length (of both sides of a plate).

    For named points, the one with the largest shape of the first elastic mode.
    """
    domain = rig.modes.domain
    if isinstance(domain, NamedPoints):
        first, names = int(np.argmax(rig.modes.omega > 0)), domain.grid(1)
        return str(names[int(np.argmax(np.abs(rig.modes.phi(names)[:, first])))])
    if isinstance(domain, Interval):
        return share * domain.length
    return (share * domain.length[0], share * domain.length[1])


def try_out(rig: Rig, design: Design) -> DesignResult:
    """Design the law, close the loop through the sensors' modal filters, and simulate the response to the impulse.

    Raises:
        ValueError: places, weights or numbers that admit no design; the message states a remedy.
    """
    modes, domain, places = rig.modes, _domain(rig), [*design.actuators, *design.sensors, design.impulse_at]
    on_plate = isinstance(domain, Rectangle)
    if isinstance(domain, NamedPoints):
        domain.locate(places)
    elif wrong := [at for at in places if isinstance(at, tuple) != on_plate]:
        wanted = "a pair (x, y) on the plate" if on_plate else "a position along the structure"
        raise StudyError(f"a place is {wanted}, m; got {wrong[0]}")
    if design.controlled > modes.n_modes:
        raise DesignError(f"{design.controlled} controlled modes, but the rig has {modes.n_modes}; control fewer")
    kind = _kind(rig, design.impulse_at)
    actuators = [replace(kind, name=f"F{i + 1}", at=centred_at(kind.at, at)) for i, at in enumerate(design.actuators)]
    if design.law == "IMSC":
        law = imsc(modes, design.controlled, actuators, weight=design.weight)
    else:
        law = coupled_lqr(modes, design.controlled, actuators, weight=design.weight[0])
    sensed = design.sensors
    through = filter_on(rig.structure, modes, range(design.controlled), sensed) if sensed else None
    loop = close_loop(modes, law, through)
    fastest = float(loop.poles.real.max())
    if fastest * design.final_time > MOST_GROWTH:
        raise DesignError(_instability(modes, law, through, fastest))
    state = impulse_state(modes, design.impulse_at)
    at_rest = state.copy()
    at_rest[modes.n_modes + design.controlled :] = 0.0  # so that W_r is the energy that control adds to the mode
    response = initial_response(loop, np.linspace(0.0, design.final_time, N_TIMES), state)
    effort = float(simpson((response.forces**2).sum(axis=0), x=response.time))
    return DesignResult(law, loop, response, finite_spillover(loop, at_rest, design.final_time), effort)


def _instability(modes: Modes, law: Law, through: ModalFilter | None, fastest: float) -> str:
    """The message about an unstable loop: its residual modes that grow, and whether it is stable without any."""
    found = f"the loop is unstable, with a pole of real part {fastest:+.3g} 1/s"
    if through is None:
        return f"{found}; raise R, or move actuators"
    explained = explain_spillover(modes, filtered(law, through))
    growing = [str(1 + one.mode) for one in explained.shifts if one.closed_pole.real > 0.0]
    if growing:
        found += f": residual mode{'s' * (len(growing) > 1)} {joined_in_words(growing)} grow{'s' * (len(growing) == 1)}"
    rate = explained.reduced_decay_rate
    alone = "stable" if rate > 0.0 else f"unstable too (decay rate {rate:.3g} 1/s)"
    return f"{found}; without residual modes it is {alone}; move or add sensors, or raise R"


def _kind(rig: Rig, at: Place) -> Actuator:
    """The kind of actuator that a design has: a patch of the rig, or a force."""
    return patch_of(rig) or Actuator("F", at)


def results_of(rig: Rig, design: Design) -> dict[str, Any]:
    """The results of a design that the bench displays, as plain numbers."""
    tried = try_out(rig, design)
    step = (N_TIMES - 1) // (N_FRAMES - 1)
    poles = tried.loop.poles
    energy = tried.response.energy[:, ::step].sum(axis=0)
    return {
        "residual": all_rounded(tried.work.residual_work),
        "by_mode": all_rounded(tried.work.work_by_mode),
        "effort": all_rounded(tried.effort),
        "peak_force": all_rounded(np.abs(tried.response.forces).max()),
        "stable": not tried.loop.unstable_poles.size,
        "undamped": int(np.sum(np.abs(poles.real) <= ON_AXIS * np.abs(poles)) // 2),
        "rightmost": all_rounded(poles.real.max()),
        "poles": [[all_rounded(p.real), all_rounded(p.imag)] for p in poles if p.imag >= 0],
        "time": all_rounded(tried.response.time[::step]),
        "modal": all_rounded(tried.response.modal[: rig.modes.n_modes, ::step]),
        "energy": all_rounded(energy),
        "forces": all_rounded(tried.response.forces[:, ::step]),
        "impulse_shape": all_rounded(rig.modes.phi(design.impulse_at)[0]),
    }


def setting(rig: Rig, units: Units = SI) -> dict[str, Any]:
    """Data that the page of the bench loads once: the structure, its modes and its shapes, and the labels of axes."""
    domain, first = _domain(rig), start(rig)
    effort, peak = command_headings(command_unit([_kind(rig, first.impulse_at)]))
    labels = {
        "residual": "spillover work W_R [J]", "by_mode": "spillover work W_r [J]", "energy": "energy of all modes [J]",
        "effort": effort, "peak_force": peak, "forces": peak.removeprefix("peak "), "time": "time [s]",
        "final_time": "final time [s]", "real": "real part [rad/s]", "imaginary": "imaginary part [rad/s]",
        "rate": "1/s", "clock": "s", "x": "x [m]", "y": "y [m]",
    }  # fmt: skip
    return {
        "labels": {name: units.named(label) for name, label in labels.items()},
        **(_frame(rig, domain) if isinstance(domain, NamedPoints) else _field(rig, domain)),
        "omega": all_rounded(rig.modes.omega),
        "zeta": all_rounded(rig.modes.zeta),
        "most": MOST_TRANSDUCERS,
        "laws": LAWS,
        "design": {name: list(v) if isinstance(v, tuple) else v for name, v in asdict(first).items()},
    }


def _field(rig: Rig, domain: Interval | Rectangle) -> dict[str, Any]:
    """Drawing data of a member or a plate: where its shapes are shown, the shapes there, and the size of a patch."""
    if isinstance(domain, Interval):
        shown_at, across = np.linspace(0.0, domain.length, N_PLACES), [N_PLACES]
    else:  # centres of cells, each drawn in one colour
        across = [max(round(N_CELLS * side / max(domain.length)), 8) for side in domain.length]
        x, y = ((np.arange(n) + 0.5) / n * side for n, side in zip(across, domain.length, strict=True))
        shown_at = np.column_stack([np.repeat(x, y.size), np.tile(y, x.size)])
    patch = patch_of(rig)
    return {
        "length": domain.length,
        "cells": across,
        "x": all_rounded(shown_at),
        "shapes": all_rounded(rig.modes.phi(shown_at)),
        "patch": [] if patch is None else all_rounded(2.0 * reach(domain, patch.at)[0]),
    }


def _frame(rig: Rig, domain: NamedPoints) -> dict[str, Any]:
    """Drawing data of a frame: nodes, lines between them, mode shapes, and the drawn position of each point."""
    wireframe = frame_wireframe(domain)
    corner, size = wireframe.rest.min(axis=0), float(np.ptp(wireframe.rest, axis=0).max())
    names = domain.grid()
    # points of one node are drawn beside the node, each in its own direction
    ways = {"": (0.0, 0.0), "x": (1.0, 0.0), "y": (0.0, 1.0), "z": (0.6, 0.6)}
    moves = np.asarray(wireframe.moves(rig.modes))
    return {
        "length": all_rounded(np.maximum(np.ptp(wireframe.rest, axis=0), SLENDER * size)),
        "points": {
            "names": names,
            "spots": all_rounded(np.array([wireframe.at(name) for name in names]) - corner),
            "ways": [ways[domain.directions[domain.locate(name)[0]]] for name in names],
            "rest": all_rounded(wireframe.rest - corner),
            "lines": wireframe.lines,
        },
        "shapes": all_rounded(moves.reshape(-1, rig.modes.n_modes)),
        "patch": [],
    }


def read_structure(path: Path | None) -> tuple[Rig, str, Units]:
    """The rig of a TOML file or case folder, with the TOML text and its units; the beam of the dissertation if None."""
    path = Path(__file__).with_name("assets") / "bench.toml" if path is None else path
    path = path / "case.toml" if path.is_dir() else path
    return read_rig(path), path.read_text(encoding="utf-8"), read_units(path)
