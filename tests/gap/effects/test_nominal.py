"""Errors of a nominal model, beside effects."""

from dataclasses import replace

import numpy as np

from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import IdentifiedPrior, NominalPrior, nominal_errors
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig, shape_of
from workbench.rig.sensors import Sensor
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import NamedPoints
from workbench.structure.finite_elements import FiniteElements
from workbench.structure.plate import Plate
from workbench.trials.plane_frame import Section, plane_frame


def test_an_exchanged_sensor_that_is_off_its_place_stays_on_the_structure(hinged_rig):
    rig = hinged_rig(n_modes=3)
    length = rig.modes.domain.size
    rig = replace(rig, sensors=(*rig.sensors[:3], replace(rig.sensors[3], at=length)))
    errors = nominal_errors(rig, NominalPrior(place=0.001))
    errors = replace(errors, values=dict.fromkeys(errors.values, 0.002))
    exchanged = Effect(kind_named("swapped_outputs"), ("d1", "d4"), {})
    off = apply_all(rig, (exchanged, errors))
    assert np.isfinite([shape_of(off.modes, sensor) for sensor in off.sensors]).all()
    assert sorted(sensor.at for sensor in off.sensors)[-1] == length


def test_errors_stay_where_they_are_when_their_size_is_learnt_to_be_smaller(hinged_rig):
    """Else a rig that bears a load by them would buckle."""
    rig = hinged_rig(n_modes=3)
    before = nominal_errors(rig, NominalPrior(stiffness=0.02), {"stiffness_1": 0.15})
    assert nominal_errors(rig, replace(before.target, stiffness=0.01), before.values).values == before.values


def test_an_uneven_stiffness_turns_modes_into_one_another_as_it_does_in_the_matrices():
    """To first order by e_rs = φ_rᵀ δK φ_s / (ω_r ω_s); what is left is of second order, and of modes beyond."""
    section = Section(axial=1e6, bending=5.0, mass=3.0)
    nodes = {f"{side}{k}": (x, 0.5 * k) for side, x in (("L", 0.0), ("R", 0.7)) for k in range(4)}
    strips = [(f"{s}{k}", f"{s}{k + 1}", section) for s in "LR" for k in range(3)]
    strips += [(f"L{k}", f"R{k}", section) for k in (1, 2, 3)]
    even, uneven = (
        plane_frame(nodes, strips, fixed=("L0", "R0"), damping=ModalDamping(0.01), stiffness_waves=waves)
        for waves in ((), (0.01, -0.02))
    )
    modes, real = even.modes(8), uneven.modes(8)
    names = [*modes.domain.names]
    shapes, off = modes.phi(names), uneven.stiffness.toarray() - even.stiffness.toarray()
    rig = Rig(modes, [Actuator("F", "L1.x")], [Sensor("a", "R3.x")])
    prior = NominalPrior(coupling=0.01)
    start = {}
    for name in nominal_errors(rig, prior).values:
        r, s = (int(number) - 1 for number in name.split("_")[1:])
        start[name] = float(shapes[:, r] @ off @ shapes[:, s] / (modes.omega[r] * modes.omega[s]))
    turned = apply_all(rig, (nominal_errors(rig, prior, start),)).modes.phi(names)
    true = real.phi(names) * np.sign(np.sum(real.phi(names) * shapes, axis=0))
    lowest = slice(0, 5)
    before, after = (np.linalg.norm((x - true)[:, lowest]) for x in (shapes, turned))
    assert after < 0.2 * before and before > 0.01 * np.linalg.norm(true[:, lowest])
    mass = even.mass.toarray()
    np.testing.assert_allclose(turned.T @ mass @ turned, np.eye(8), atol=1e-9)


def test_an_uneven_mass_brings_rigid_motion_into_elastic_modes_as_it_does_in_the_matrices():
    """Two inertias with a spring between them: φ_s gains -φ_rᵀ δM φ_s φ_r, and the rigid mode nothing."""
    points = NamedPoints(("motor", "load"))
    mass, stiffness = np.diag([2e-3, 5e-3]), 40.0 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    modes = FiniteElements(mass, stiffness, nodes=points).modes(2)
    shapes = modes.phi(points.names)
    off = 0.01
    uneven = np.linalg.inv(shapes @ np.array([[1.0, off], [off, 1.0]]) @ shapes.T)  # (Φ X Φᵀ)⁻¹, X⁻¹ in modes
    true = FiniteElements(uneven, stiffness, nodes=points).modes(2).phi(points.names)
    true *= np.sign(np.sum(true * shapes, axis=0))
    rig = Rig(modes, [Actuator("torque", "motor")], [Sensor("angle", "load")])
    errors = nominal_errors(rig, NominalPrior(coupling=0.01), {"coupling_1_2": off})
    found = apply_all(rig, (errors,)).modes.phi(points.names)
    assert np.abs(true - shapes).max() > 0.005 * np.abs(shapes).max()
    np.testing.assert_allclose(found, true, atol=3.0 * off**2 * np.abs(shapes).max())
    np.testing.assert_allclose(found[:, 0], shapes[:, 0], rtol=1e-12)


def test_a_plate_that_is_a_little_off_has_the_modes_left_out_of_its_model():
    """Navier: ω_ij = π² (i²/a² + j²/b²) sqrt(D / m); the errors are those of the modes kept, and of no other."""
    a, b, stiffness, mass, kept, needed = 0.6, 0.4, 160.0, 8.0, 4, 9
    plate = Plate(
        length=(a, b),
        mass_per_area=mass,
        bending_stiffness=stiffness,
        poisson_ratio=0.3,
        edges="simply supported",
        damping=ModalDamping(0.01),
    )
    rig = Rig(plate.modes(kept), (), (), structure=plate)
    errors = nominal_errors(rig, NominalPrior(mass=0.02, frequency=0.005, damping=0.2))
    errors = replace(errors, values={**errors.values, "mass_0": 0.01, "frequency_1": 0.02, "damping_1": 0.3})
    more = Effect(kind_named("truncated_modes"), needed, {})
    i, j = np.mgrid[1:9, 1:9]
    navier = np.sort((np.pi**2 * ((i / a) ** 2 + (j / b) ** 2) * np.sqrt(stiffness / mass)).ravel())[:needed]
    expected = navier * np.exp(np.r_[0.02, np.zeros(needed - 1)])
    damping = 0.01 * np.exp(np.r_[0.3, np.zeros(needed - 1)])
    for order in ((errors, more), (more, errors)):
        modes = apply_all(rig, order).modes
        np.testing.assert_allclose(modes.omega, expected, rtol=1e-9)
        np.testing.assert_allclose(modes.zeta, damping, rtol=1e-9)


def test_an_identified_structure_has_the_modes_left_out_of_its_model(hinged_rig):
    rig = hinged_rig(n_modes=3)
    prior = IdentifiedPrior(lambda errors: rig, np.eye(1))
    off = apply_all(rig, (nominal_errors(rig, prior), Effect(kind_named("truncated_modes"), 6, {})))
    ratio = off.modes.omega / rig.modes.omega[0]
    np.testing.assert_allclose(ratio, np.arange(1, 7) ** 2, rtol=1e-5)
