"""Modes with something attached, from modes at hand, against a structure that is solved anew."""

import numpy as np
import pytest

from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam
from workbench.structure.modification import attach
from workbench.structure.supports import PointDamper, PointMass, PointSpring


def beam(*attachments):
    return Beam(
        length=2.0,
        mass_per_length=3.0,
        bending_stiffness=50.0,
        left="clamped",
        right="free",
        damping=ModalDamping(0.01),
        attachments=attachments,
    )


@pytest.mark.parametrize(
    "parts",
    [
        (PointSpring(1.3, 4000.0),),
        (PointMass(1.3, 0.5), PointSpring(0.7, 900.0)),
        (PointSpring(1.3, 300.0), PointSpring(1.3, 200.0)),
        (PointMass(2.0, 1.0), PointDamper(0.9, 2.0)),
    ],
)
def test_the_static_answer_of_modes_left_out_makes_the_few_that_are_kept_exact(parts):
    exact = beam(*parts).modes(5)
    many = beam().modes(60)
    with_rest, without = attach(many, parts, kept=5), attach(beam().modes(20), parts).select(slice(5))
    error, worse = np.abs(with_rest.omega / exact.omega - 1), np.abs(without.omega / exact.omega - 1)
    assert error.max() < 2e-5 and error.max() < 0.2 * worse.max()
    places = np.linspace(0.1, 2.0, 12)
    shapes, expected = with_rest.phi(places), exact.phi(places)
    signs = np.sign(np.sum(shapes * expected, axis=0))
    np.testing.assert_allclose(shapes * signs, expected, atol=2e-3 * np.abs(expected).max())
    np.testing.assert_allclose(np.diag(with_rest.damping), np.diag(exact.damping), rtol=2e-3)
