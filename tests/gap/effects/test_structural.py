"""Structures as a search alters them: one solution of a plate serves every stiffness and damping of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh

from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect, apply_all, can_be, from_other_starts
from workbench.gap.effects.structural import modes_of
from workbench.rig.rig import Rig
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import Between, NamedPoints
from workbench.structure.member import Beam
from workbench.structure.modes import Modes, PointShapes
from workbench.structure.plate import Plate
from workbench.structure.supports import Edge, PointMass, PointSpring


def _plate(**changes) -> Plate:
    facts = {
        "length": (1.0, 0.7),
        "mass_per_area": 2.0,
        "bending_stiffness": 3.0,
        "poisson_ratio": 0.3,
        "edges": {"left": "clamped", "right": "simply supported", "bottom": "simply supported", "top": "clamped"},
        "damping": ModalDamping(0.01),
    }
    return Plate(**{**facts, **changes})


def test_a_stiffer_and_more_damped_plate_with_a_mass_is_that_plate_solved_anew(monkeypatch):
    plate = _plate()
    rig = Rig(modes_of(plate, 4), (), (), structure=plate)
    solved = []
    solve = Plate.modes
    monkeypatch.setattr(Plate, "modes", lambda self, *args, **how: solved.append(self) or solve(self, *args, **how))
    for factor, mass in ((1.3, 0.01), (0.8, 0.02)):
        for name, values in (
            ("modulus_error", {"factor": factor}),
            ("modal_damping", {"factor": 2.0}),
            ("point_mass", {"x": 0.3, "y": 0.45, "mass": mass}),
        ):
            rig = kind_named(name).apply(rig, None, values)
    assert not solved, "a search has no time for another solution"
    anew = _plate(
        bending_stiffness=3.0 * 1.3 * 0.8,
        attachments=[PointMass((0.3, 0.45), 0.03)],
        damping=ModalDamping(0.04),
    ).modes(4)
    np.testing.assert_allclose(rig.modes.omega, anew.omega, rtol=3e-5)
    np.testing.assert_allclose(rig.modes.zeta, 0.04, rtol=1e-12)
    at = (0.62, 0.31)
    np.testing.assert_allclose(rig.modes.phi(at), anew.phi(at), atol=1e-3 * np.abs(anew.phi(at)).max())


@pytest.mark.parametrize("other", [{"tension": 40.0}, {"edges": Edge(200.0, 1.0)}], ids=["tension", "elastic edges"])
def test_what_is_stiff_beside_bending_stays_as_it_is(other):
    plate = _plate(**other)
    rig = kind_named("modulus_error").apply(Rig(plate.modes(3), (), (), structure=plate), None, {"factor": 1.5})
    np.testing.assert_allclose(rig.modes.omega, _plate(**other, bending_stiffness=4.5).modes(3).omega, rtol=1e-4)


@pytest.mark.parametrize(
    ("edges", "within"), [("simply supported", 1e-6), pytest.param("clamped", 2e-5, marks=pytest.mark.slow)]
)
def test_what_stands_on_a_plate_feels_the_modes_that_are_left_out(edges, within):
    plate = _plate(edges=edges)
    for part in (PointMass((0.52, 0.33), 0.03), PointSpring((0.3, 0.45), 200.0)):
        there = replace(plate, attachments=(part,))
        exact = there.modes(8, tolerance=1e-5).omega[:4]
        np.testing.assert_allclose(modes_of(there, 8).omega[:4], exact, rtol=within)


@pytest.mark.parametrize("edges", ["simply supported", "clamped"])
def test_a_plate_has_the_modes_that_a_model_left_out(edges, monkeypatch):
    plate = _plate(edges=edges)
    rig = Rig(modes_of(plate, 4), (), (), structure=plate)
    exact = plate.modes(20)
    solved = []
    solve = Plate.modes
    monkeypatch.setattr(Plate, "modes", lambda self, *args, **how: solved.append(self) or solve(self, *args, **how))
    for count in (5, 7, 20):
        full = kind_named("truncated_modes").apply(rig, count, {}).modes
        np.testing.assert_allclose(full.omega, exact.omega[:count], rtol=1e-4)
        np.testing.assert_allclose(full.zeta, 0.01)
    assert not solved, "a search has no time for a solution of each count"


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_a_damper_is_as_strong_whichever_effect_was_found_first(order):
    rng = np.random.default_rng(11)
    omega, zeta, (m, c, factor) = np.array([9.0, 20.0, 31.0, 55.0]), 0.01, (0.4, 0.7, 1.2)
    shapes = rng.normal(size=(3, 4))
    points = NamedPoints(("p", "q", "r"))
    rig = Rig(Modes(omega=omega, damping=np.full(4, zeta), shapes=PointShapes(shapes), domain=points), (), ())
    effects = [
        Effect(kind_named("point_damper"), None, {"at": Between("p", "q"), "coefficient": c}),
        Effect(kind_named("point_mass"), None, {"at": "r", "mass": m}),
        Effect(kind_named("modulus_error"), None, {"factor": factor}),
    ]
    poles = np.linalg.eigvals(apply_all(rig, [effects[i] for i in order]).modes.state_matrix)
    # the same by hand: modes of the heavier structure keep their ratios, and the damper acts on them
    values, vectors = eigh(np.diag(factor * omega**2), np.eye(4) + m * np.outer(shapes[2], shapes[2]))
    felt = (shapes[0] - shapes[1]) @ vectors
    damping = np.diag(2.0 * zeta * np.sqrt(values)) + c * np.outer(felt, felt)
    expected = np.linalg.eigvals(np.block([[np.zeros((4, 4)), np.eye(4)], [-np.diag(values), -damping]]))
    np.testing.assert_allclose(np.sort_complex(poles), np.sort_complex(expected), rtol=1e-9)


def test_a_loss_of_stiffness_that_leaves_the_structure_cannot_be():
    """Of two losses made one, the wider may not fit where the narrower stands."""
    beam = Beam(length=1.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged")
    rig = Rig(beam.modes(3), (), (), structure=beam)
    kind = kind_named("local_stiffness_loss")
    inside, outside = (Effect(kind, None, {"at": 0.07, "width": width, "loss": 0.1}) for width in (0.1, 0.16))
    assert can_be(rig, [inside])
    assert not can_be(rig, [inside, outside])


@pytest.mark.parametrize(("width", "loss"), [(0.012, 0.5), (0.19, 0.02)])
def test_a_loss_starts_over_another_width_with_its_added_compliance(width, loss):
    """What a stretch far shorter than a wave adds to the compliance is all that lowers its frequency."""
    beam = Beam(length=1.2, mass_per_length=0.5, bending_stiffness=8.0, left="hinged", right="hinged")
    rig = Rig(beam.modes(2), (), (), structure=beam)
    start = Effect(kind_named("local_stiffness_loss"), None, {"at": 0.43, "width": width, "loss": loss})
    ((other,),) = from_other_starts((start,), rig)
    assert other.values["width"] == pytest.approx(0.12)
    lowered = [1.0 - apply_all(rig, (each,)).modes.omega / rig.modes.omega for each in (start, other)]
    np.testing.assert_allclose(*lowered, rtol=0.1)
    assert not list(from_other_starts((other,), rig))
