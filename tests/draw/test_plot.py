"""Every result has a figure."""

import workbench as wb
from workbench.draw.plot import plot
from workbench.identification.signal.synthesis import free_decay, impulse_response_modes
from workbench.structure.damping import ModalDamping


def test_identified_modes_have_a_figure_of_their_shapes():
    beam = wb.Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged",
                   damping=ModalDamping(0.01))  # fmt: skip
    decay = impulse_response_modes(beam.modes(2), at=7.3, positions=[1.0, 3.0, 6.0])
    record = free_decay(decay, sample_time=0.5, n_samples=600, quantity="velocity", noise_std=0.003, seed=3)
    for found in (wb.identify(record), wb.ring_down([record])):
        titles = [ax.get_title("left") for ax in plot(found).axes if ax.get_visible()]
        assert titles[0].startswith("mode 1: 0.0157") and titles[1].startswith("mode 2: 0.0628")
