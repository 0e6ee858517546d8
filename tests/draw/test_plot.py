"""Every result has a figure."""

import numpy as np
import pytest

import workbench as wb
from workbench.design.loop.closed_loop import Response
from workbench.draw.plot import plot
from workbench.draw.style import few_ticks
from workbench.identification.shapes.bands import Bands
from workbench.identification.signal.synthesis import free_decay, impulse_response_modes
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import listed, place_array


def test_identified_modes_have_a_figure_of_their_shapes():
    beam = wb.Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged",
                   damping=ModalDamping(0.01))  # fmt: skip
    decay = impulse_response_modes(beam.modes(2), at=7.3, positions=[1.0, 3.0, 6.0])
    record = free_decay(decay, sample_time=0.5, n_samples=600, quantity="velocity", noise_std=0.003, seed=3)
    for found in (wb.identify(record), wb.ring_down([record])):
        titles = [ax.get_title("left") for ax in plot(found).axes if ax.get_visible()]
        assert titles[0].startswith("mode 1: 0.0157") and titles[1].startswith("mode 2: 0.0628")


ON = {"left": "clamped", "right": "free", "bottom": "free", "top": "free"}
PLATE = wb.Plate(length=(0.6, 0.4), mass_per_area=8.0, bending_stiffness=170.0, poisson_ratio=0.3, edges=ON)
BEAM = wb.Beam(length=1.0, mass_per_length=1.0, bending_stiffness=1.0, left="clamped", right="free").modes(3)
POINTS = wb.NamedPoints(("S1", "S2", "S3"), np.array([[0, 0, 1], [0, 0, 2], [0, 0, 3]]), ("x",) * 3)
FRAME = wb.FiniteElements(np.eye(3), np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 1]]), nodes=POINTS).modes(3)


@pytest.fixture(scope="module")
def plate():
    return PLATE.modes(3, tolerance=1e-3)


@pytest.mark.parametrize("modes", [BEAM, None, FRAME], ids=["beam", "plate", "frame"])
def test_what_is_known_on_any_domain_has_a_figure(modes, plate):
    modes = plate if modes is None else modes
    places = list(modes.domain.grid(4))
    sampled = wb.SampledModes(modes.omega, np.zeros(3), modes.phi(places), place_array(places))
    assert listed(sampled.positions) == places
    moving = Response(np.linspace(0.0, 1.0, 30), np.zeros((6, 30)), np.zeros((1, 30)), modes)
    for result in (modes, sampled, moving):
        figure = plot(result)
        figure.draw_without_rendering()
        assert any(ax.has_data() for ax in figure.axes)


def test_the_bands_of_a_plate_are_drawn_where_they_are_wide(plate):
    at = np.array(plate.domain.grid(8))
    std = np.outer(at[:, 0] / 0.6, [0.1, 0.2, 0.3])
    bands = Bands(at, plate.phi(at), std, 0.5 * std, np.full(3, 3.0), 0.95)
    figure = plot(bands)
    below = [ax for ax in figure.axes if ax.has_data()][3:6]
    for r, ax in enumerate(below):
        share = 100.0 * std[:, r].max() / np.abs(bands.phi[:, r]).max()
        assert ax.collections[0].get_array().max() <= 1.2 * share and ax.collections[0].levels[-1] >= share
    assert "of 3 eigenfunctions at" in str(bands)
    with pytest.raises(ValueError, match="on one line: give a grid"):
        plot(Bands(at[:3], bands.phi[:3], std[:3], std[:3], np.full(3, 3.0), 0.95))


def test_a_response_at_many_points_shows_those_that_move_most():
    n = 20
    points = wb.NamedPoints(tuple(f"S{i}" for i in range(n)), None, ("x",) * n)
    modes = wb.FiniteElements(np.eye(n), np.diag(np.arange(1.0, n + 1)), nodes=points).modes(n)
    law = wb.imsc(modes, 1, [wb.Actuator("F1", "S0")], weight=1.0)
    response = wb.initial_response(wb.close_loop(modes, law), np.linspace(0, 9, 50), np.r_[np.arange(n), np.zeros(n)])
    figure = plot(response)
    assert [ax.get_ylabel() for ax in figure.axes] == [f"S{i}" for i in range(8, n)]
    assert "of the 12 points of 20 that move most" in figure.axes[0].get_title("left")


def test_an_explanation_at_named_points_is_printed_and_drawn():
    law = wb.imsc(FRAME, 1, [wb.Actuator("F1", "S3")], weight=1.0)
    explained = wb.explain_spillover(
        FRAME, wb.kalman_controller(FRAME, law, [wb.Sensor("y", "S3")], disturbance=1.0, noise=0.1)
    )
    assert "  y → F1" in str(explained) and str(explained).startswith("closed loop of 3 modes: ")
    assert "y → F1" in [label.get_text() for label in plot(explained).axes[1].get_yticklabels()]
    assert "position [m]" not in str(law)


@pytest.mark.filterwarnings("error")
def test_work_that_residual_modes_lose_is_drawn_below_zero():
    modes = wb.Beam(length=2.0, mass_per_length=1.0, bending_stiffness=4.0, left="hinged", right="hinged").modes(6)
    law = wb.imsc(modes, 2, [wb.Actuator("A", 0.45), wb.Actuator("B", 1.2)], weight=1.0)
    for struck in (0.3, 1.3):  # residual modes move when control starts; most of the work, or a part, is taken out
        found = wb.spillover(modes, law, wb.impulse_state(modes, struck))
        (ax,) = plot(found).axes
        assert min(found.residual_work_by_mode) < 0
        assert [bar.get_height() for bar in ax.patches] == pytest.approx(found.residual_work_by_mode)
        low, high = ax.get_ylim()
        assert low < min(found.residual_work_by_mode) and max(found.residual_work_by_mode) < high


@pytest.mark.filterwarnings("error")
def test_without_residual_modes_a_figure_says_so():
    law = wb.imsc(BEAM, 3, [wb.Actuator(f"F{i}", at) for i, at in enumerate((0.3, 0.6, 0.9))], weight=1.0)
    explained = wb.explain_spillover(
        BEAM, wb.kalman_controller(BEAM, law, [wb.Sensor("y", 0.8)], disturbance=1.0, noise=0.1)
    )
    for result in (explained, wb.spillover(BEAM, law, wb.impulse_state(BEAM, 0.8))):
        assert "no mode is residual" in plot(result).axes[0].texts[0].get_text()


def test_modes_are_numbered_as_far_as_there_is_room():
    assert list(few_ticks(range(3, 9))) == list(range(3, 9))
    assert list(few_ticks(range(4, 46))) == list(range(4, 46, 3))
