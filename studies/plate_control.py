"""From a record to a controlled plate: are modes identified at twelve sensors enough to control a cantilevered panel?

Four shakers drive an aluminium panel at random; twelve noisy sensors listen, four of them beside the shakers. All that
follows knows the record and where the sensors stand, never the plate. The law designed on what was found then drives
the plate itself.
"""

from dataclasses import replace

import numpy as np
from scipy.linalg import expm

from workbench.design.laws.coupled import controlled_plant
from workbench.design.laws.imsc import imsc
from workbench.design.laws.law import Law
from workbench.design.loop.closed_loop import close_loop, impulse_state, initial_response
from workbench.design.spillover.spillover import spillover
from workbench.draw.design import plot_work_linear
from workbench.draw.surface import plot_surface_modes, plot_surface_motion
from workbench.identification.driven import identify_driven
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.rig.statespace import input_matrix
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes, mac
from workbench.structure.plate import Plate

LENGTH = (0.6, 0.4)
SHAKERS = np.array([(0.18, 0.05), (0.36, 0.33), (0.55, 0.07), (0.52, 0.31)])
OTHERS = np.array(
    [(0.1, 0.2), (0.2, 0.36), (0.3, 0.04), (0.3, 0.2), (0.4, 0.12), (0.45, 0.38), (0.58, 0.2), (0.59, 0.39)]
)
PLACES = np.vstack([SHAKERS, OTHERS])
STRUCK_AT = (0.5, 0.37)
N_MODES, N_CONTROLLED = 7, 4
NAMES = tuple(f"P{i + 1}" for i in range(len(PLACES)))


def measured():
    """The modes of a panel 3 mm thick, clamped at its left edge, and 20 s of its response to random forces."""
    plate = Plate.of_thickness(
        length=LENGTH,
        thickness=3e-3,
        density=2700.0,
        youngs_modulus=70e9,
        poisson_ratio=0.33,
        edges={"left": "clamped", "right": "free", "bottom": "free", "top": "free"},
        damping=ModalDamping(0.004),
    )
    modes = plate.modes(N_MODES)
    actuators = tuple(Actuator(f"F{i + 1}", tuple(place)) for i, place in enumerate(SHAKERS))
    sensors = tuple(Sensor(name, tuple(place), "velocity") for name, place in zip(NAMES, PLACES))
    forces = np.random.default_rng(0).standard_normal((len(SHAKERS), 1000))
    sample_time = 0.2 / modes.frequencies_hz[-1]
    quiet = simulate(Rig(modes, actuators, sensors), forces, sample_time=sample_time)
    noise = 0.02 * quiet.outputs.std() * np.random.default_rng(1).standard_normal(quiet.outputs.shape)
    return modes, replace(quiet, outputs=quiet.outputs + noise)


def identified(record):
    """Mass-normalised modes at the sensors: where force and motion meet, residues are φ_i φ_j / (2 i ω_d)."""
    found = identify_driven(record, at_rest=True, feedthrough=False, max_modes=12)
    modes, shapes = found.modes, []
    for r in range(modes.n_modes):
        products = 2j * modes.poles[r].imag * np.outer(modes.shapes[:, r], found.participation[r])
        values, vectors = np.linalg.eigh(products[: len(SHAKERS)].real)
        at_shakers = np.sqrt(values[-1]) * vectors[:, -1]
        shapes.append(products.real @ at_shakers / values[-1])
    table = np.array(shapes).T
    points = NamedPoints(NAMES, np.column_stack([PLACES, np.zeros(len(PLACES))]), ("z",) * len(PLACES))
    return Modes(modes.omega, modes.zeta, lambda index, _: table[index], points)


def quadrature_work(modes, law, state):
    """W_r of the residual modes from the motion of the loop itself, ½ |∫ f_r(t) e^{iω_r t} dt|², by Gauss's rule."""
    a, b = controlled_plant(modes, law.controlled, law.actuators)
    loop, index = a - b @ law.gain, list(law.controlled)
    x = np.r_[state[index], state[[modes.n_modes + r for r in index]]]
    rest = [r for r in range(modes.n_modes) if r not in law.controlled]
    fastest = max(np.abs(np.linalg.eigvals(loop)).max(), modes.omega[-1])
    nodes, weights = np.polynomial.legendre.leggauss(12)
    step = 2.0 / fastest
    offsets = 0.5 * step * (nodes + 1.0)
    force = -input_matrix(modes, law.actuators)[rest] @ law.gain
    inside = np.array([force @ expm(loop * offset) for offset in offsets])
    turning = 0.5 * step * weights[:, None] * np.exp(1j * np.outer(offsets, modes.omega[rest]))
    across, total = expm(loop * step), np.zeros(len(rest), complex)
    for i in range(int(40.0 / -np.linalg.eigvals(loop).real.max() / step)):
        total += np.exp(1j * modes.omega[rest] * i * step) * np.sum(turning * (inside @ x), axis=0)
        x = across @ x
    return 0.5 * np.abs(total) ** 2


def study(outcome, data=None):
    truth, record = measured()
    found = identified(record)
    there = truth.phi(PLACES)
    outcome.table("hz", {"true": truth.frequencies_hz, "identified": found.frequencies_hz})
    outcome.check("modes identified", found.n_modes, N_MODES, at_least=True)
    error = np.abs(found.omega[:N_MODES] / truth.omega - 1).max()
    outcome.check("largest error of a frequency, relative", error, 1e-3)
    at_sensors = found.phi(list(NAMES))[:, :N_MODES]
    at_sensors = at_sensors * np.sign((at_sensors * there).sum(axis=0))
    outcome.check("smallest MAC of a mode", np.diag(mac(at_sensors, there)).min(), 0.999, at_least=True)
    size = np.abs(there).max(axis=0)
    outcome.check(
        "largest error of a shape at a sensor, of its largest", (np.abs(at_sensors - there) / size).max(), 0.03
    )

    weight = 100.0 / truth.omega[0] ** 2  # for a damping ratio of 5 % in the first mode
    named = [Actuator(f"F{i + 1}", name) for i, name in enumerate(NAMES[: len(SHAKERS)])]
    designed = imsc(found, N_CONTROLLED, named, weight=weight)
    law = Law(
        designed.gain, designed.controlled, [Actuator(a.name, tuple(p)) for a, p in zip(named, SHAKERS)], "identified"
    )
    exact = imsc(truth, N_CONTROLLED, law.actuators, weight=weight)
    signs = np.sign((found.phi(list(NAMES))[:, :N_CONTROLLED] * there[:, :N_CONTROLLED]).sum(axis=0))
    law = Law(law.gain * np.r_[signs, signs], law.controlled, law.actuators, law.name)

    struck = impulse_state(truth, STRUCK_AT, 1e-3)
    time = np.linspace(0.0, 60.0 / truth.omega[0], 1500)
    nothing = Law(np.zeros_like(law.gain), law.controlled, law.actuators, "none")
    loops = {"uncontrolled": nothing, "controlled": law, "designed on the plate itself": exact}
    responses = {name: initial_response(close_loop(truth, each), time, struck) for name, each in loops.items()}
    outcome.check("decay rate of the plate under the identified law, 1/s", close_loop(truth, law).decay_rate, 0.0, True)
    kept = {
        name: float(r.energy[:N_CONTROLLED, -1].sum() / r.energy[:N_CONTROLLED, 0].sum())
        for name, r in responses.items()
    }
    outcome.table("energy left in the controlled modes", kept)
    outcome.check(
        "energy left in the controlled modes against none controlled", kept["controlled"] / kept["uncontrolled"], 0.02
    )

    undamped = Modes(truth.omega, np.zeros(N_MODES), truth.shapes, truth.domain)
    at_rest = struck * np.tile(np.arange(N_MODES) < N_CONTROLLED, 2)
    ideal = imsc(undamped, N_CONTROLLED, law.actuators, weight=weight)
    closed = spillover(undamped, ideal, at_rest).residual_work_by_mode
    by_quadrature = quadrature_work(undamped, ideal, at_rest)
    outcome.table("W_r", closed)
    difference = np.abs(by_quadrature - closed).max() / closed.sum()
    outcome.check("W_r in closed form against quadrature, relative to W_R", difference, 1e-8)
    outcome.say(f"{found.n_modes} modes identified, their frequencies to {error:.1e}")
    outcome.say(
        f"after {time[-1]:.2f} s the controlled modes keep {kept['controlled']:.1e}"
        f" of their energy, {kept['uncontrolled']:.2g}"
        " without control"
    )

    outcome.figure(
        "modes",
        plot_surface_modes(truth, places=PLACES, values=at_sensors),
        "Modes of the panel, clamped at its left edge: red up, blue down, black where nothing moves. The circles are"
        " the sensors, filled with what was identified there.",
    )
    outcome.figure(
        "motion",
        plot_surface_motion(
            {name: responses[name] for name in ("uncontrolled", "controlled")},
            [time[i] for i in (40, 220, 480, 900, 1499)],
            actuators=SHAKERS,
            impulse_at=STRUCK_AT,
        ),
        "The panel after an impulse at the star, left alone and controlled from the four crosses.",
    )
    works = {
        "design on identified modes": spillover(undamped, law, at_rest).residual_work_by_mode,
        "on the plate itself": closed,
    }
    outcome.figure("work", plot_work_linear(works, first=N_CONTROLLED), "Spillover work in the residual modes.")
