"""Modal filters on plates, by thin-plate splines: what they must see exactly, and how what they miss shrinks."""

import numpy as np
import pytest

from workbench.design.estimation.controller import filtered
from workbench.design.estimation.modal_filter import filter_on, hermite_filter, surface_filter
from workbench.design.laws.imsc import imsc
from workbench.design.loop.closed_loop import close_loop, close_with
from workbench.rig.actuators import Actuator
from workbench.structure.member import Beam
from workbench.structure.modification import attach
from workbench.structure.plate import Plate
from workbench.structure.supports import PointMass

A, B = 1.2, 0.8
RNG = np.random.default_rng(3)


def plate(edges, **options):
    given = {"length": (A, B), "mass_per_area": 8.0, "bending_stiffness": 175.0, "poisson_ratio": 0.3}
    return Plate(edges=edges, **(given | options))


def scattered(n):
    """Places of a jittered grid of about n, none near another."""
    nx = round(np.sqrt(n * A / B))
    ny = -(-n // nx)
    x, y = np.meshgrid((np.arange(nx) + 0.5) / nx * A, (np.arange(ny) + 0.5) / ny * B)
    jitter = np.random.default_rng(0).uniform(-0.2, 0.2, (2, nx * ny))
    return np.column_stack([x.ravel() + jitter[0] * A / nx, y.ravel() + jitter[1] * B / ny])


def test_motions_of_a_rigid_plate_are_seen_exactly_from_any_sensors():
    free = plate("free", mass_per_area=lambda x, y: 8.0 + 3.0 * x * y).modes(6)
    assert (free.omega[:3] == 0).all()
    found = surface_filter(free, scattered(10), lambda x, y: 8.0 + 3.0 * x * y).response_to(free)
    np.testing.assert_allclose(found[:, :3], np.eye(6, 3), atol=1e-6)


@pytest.mark.parametrize("edges", ["simply supported", "clamped", {"left": "clamped"}])
def test_more_sensors_see_the_modes_better(edges):
    if isinstance(edges, dict):
        edges = dict.fromkeys(("right", "bottom", "top"), "free") | edges
    structure = plate(edges)
    modes = structure.modes(6)
    off = [
        np.abs(filter_on(structure, modes, range(6), scattered(n)).response_to(modes) - np.eye(6)).max()
        for n in (12, 48, 192)
    ]
    assert off[1] < 0.35 * off[0] and off[2] < 0.35 * off[1] and off[2] < 0.02, off


def test_a_law_through_a_filter_of_many_sensors_is_nearly_that_of_exact_modes():
    structure = plate("simply supported")
    modes = structure.modes(8)
    law = imsc(modes, 2, [Actuator("F1", (0.3, 0.24)), Actuator("F2", (0.84, 0.52))], weight=0.01)
    filter_ = filter_on(structure, modes, law.controlled, scattered(150))
    loop, exact = close_with(modes, filtered(law, filter_)), close_loop(modes, law)
    np.testing.assert_allclose(np.sort(loop.poles.real)[:4], np.sort(exact.poles.real)[:4], rtol=0.02)
    np.testing.assert_allclose(loop.matrix, close_loop(modes, law, filter_).matrix, atol=1e-9)


def test_attached_masses_and_inertias_are_part_of_the_mass_that_a_filter_integrates():
    heavy = (PointMass(0.8, 0.4, 0.004), PointMass(1.2, 0.1))
    beam = Beam(
        length=1.2, mass_per_length=0.62, bending_stiffness=14.0, left="clamped", right="free", attachments=heavy
    )
    modes, places = beam.modes(5), np.linspace(0.05, 1.2, 24)
    seen = filter_on(beam, modes, [0, 1], places).response_to(modes)
    np.testing.assert_allclose(seen[:, :2], np.eye(2), atol=1e-3)  # by mass per length alone 0.4 off
    np.testing.assert_allclose(seen, np.eye(2, 5), atol=0.03)  # slopes of higher modes are known less well
    again = filter_on(beam, modes, [0, 1], places).designed_by(modes, [1, 0])
    np.testing.assert_allclose(again.response_to(modes), seen[::-1], atol=1e-12)
    both = hermite_filter(modes.select([0, 1]), np.linspace(0.0, 1.2, 24), 0.62).response_to(modes)
    np.testing.assert_allclose(both, np.eye(2, 5), atol=0.03)
    surface = plate("simply supported", attachments=(PointMass((0.4, 0.4), 3.0),))
    for found in (surface.modes(6, tolerance=1e-3), attach(plate("simply supported").modes(60), surface.attachments)):
        seen = filter_on(surface, found, [0, 1], scattered(150)).response_to(found)[:, :2]
        np.testing.assert_allclose(seen, np.eye(2), atol=0.02)


def test_a_filter_of_a_beam_takes_its_sensors_in_any_order():
    beam = Beam(length=2.0, mass_per_length=1.0, bending_stiffness=4.0, left="hinged", right="hinged")
    modes, places = beam.modes(3), [0.4, 1.6, 0.9, 1.3]
    one, other = (filter_on(beam, modes, range(3), at) for at in (places, sorted(places)))
    np.testing.assert_array_equal(one.displacement, other.displacement)


@pytest.mark.parametrize(
    ("places", "words"),
    [
        ([(0.3, 0.2), (0.9, 0.6)], "a filter of 3 modes on a plate needs at least as many sensors; got 2: add sensors"),
        ([(0.3, 0.2), (0.6, 0.4), (0.9, 0.6)], "not on one line; got 3"),
        ([(0.3, 0.2), (0.3, 0.2), (0.9, 0.6)], "two of the 3 sensors are at one place"),
        ([(0.3, 0.2), (1.3, 0.4), (0.9, 0.6)], r"\(1.3, 0.4\) lies outside the structure"),
    ],
)
def test_too_few_readings_for_a_surface_are_refused(places, words):
    with pytest.raises(ValueError, match=words):
        surface_filter(plate("free").modes(3), places, 8.0)


def test_a_mode_that_the_sensors_cannot_see_is_named():
    structure = plate("simply supported")
    modes = structure.modes(4)
    law = imsc(modes, 2, [Actuator("F1", (0.3, 0.24)), Actuator("F2", (0.84, 0.52))], weight=0.01)
    midline = filter_on(structure, modes, law.controlled, [(0.6, 0.2), (0.6, 0.4)])
    with pytest.raises(ValueError, match=r"mode 2 is unobservable: the filter.s sensors at 0.6, 0.2; 0.6, 0.4"):
        close_loop(modes, law, midline)
