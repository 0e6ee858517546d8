"""Ends told rightly and wrongly of uniform beams whose modes are known in closed form."""

import re

import numpy as np
import pytest

from workbench.identification.free_decay.refinement import refine
from workbench.identification.shapes.bands import check_ends, eigenfunction_bands
from workbench.identification.shapes.eigenfunctions import BoundaryConditions
from workbench.identification.signal.synthesis import free_decay
from workbench.structure.member import Beam
from workbench.structure.modes import SampledModes

LENGTH, ENDS = 2.0, ("hinged", "clamped", "free", "sliding")


def refined(left, *, level, seed, n_sensors=8, n_modes=3):
    modes = Beam(length=LENGTH, mass_per_length=1.5, bending_stiffness=1.0, left=left, right="hinged").modes(
        n_modes + 1
    )
    elastic = np.flatnonzero(modes.omega > 1e-3)[:n_modes]
    positions, rng = np.linspace(0.1, 1.9, n_sensors), np.random.default_rng(seed)
    shapes = modes.phi(positions)[:, elastic] * rng.uniform(0.5, 1.0, n_modes)
    omega = modes.omega[elastic]
    truth = SampledModes(omega, np.full(n_modes, 0.01), shapes, positions)
    noise = level * np.sqrt(0.5 * (shapes**2).sum(axis=1).mean())
    record = free_decay(truth, sample_time=1.25 / omega.max(), n_samples=600, noise_std=noise, seed=seed)
    return refine(record, truth)


def told(left):
    return BoundaryConditions.of("beam", length=LENGTH, left=left, right="hinged")


@pytest.mark.parametrize("level", [0.01, 1e-4])
@pytest.mark.parametrize("left", ENDS)
def test_an_end_told_wrongly_is_refused_and_one_told_rightly_is_not(left, level):
    found = refined(left, level=level, seed=0)
    check_ends(found, told(left), length=LENGTH)
    for other in set(ENDS) - {left}:
        with pytest.raises(ValueError, match="the left end is stated to have zero"):
            check_ends(found, told(other), length=LENGTH)


def test_the_refusal_says_what_the_shapes_say_instead():
    """A hinge told as a clamp: the first mode, sin(πx/L), has a slope of π there, of its largest entry."""
    found = refined("hinged", level=0.01, seed=1, n_modes=1)
    with pytest.raises(ValueError, match="to have zero value and slope") as refusal:
        eigenfunction_bands(found, np.linspace(0.0, LENGTH, 5), length=LENGTH, ends=told("clamped"))
    slope, std = map(float, re.search(r"mode 1 has a slope of (\S+) ± (\S+) there", str(refusal.value)).groups())
    assert abs(slope - np.pi) < 3.0 * std < 1.0
    assert "leave it out" in str(refusal.value)
    with pytest.raises(ValueError, match="the right end is stated to have zero value and slope"):
        check_ends(found, BoundaryConditions.of("beam", length=LENGTH, right="clamped"), length=LENGTH)


def test_too_few_sensors_contradict_nothing():
    check_ends(refined("hinged", level=0.01, seed=2, n_sensors=2, n_modes=1), told("clamped"), length=LENGTH)


@pytest.mark.slow
def test_ends_told_rightly_are_hardly_ever_refused():
    """Of 400 ends, of up to five modes and twelve sensors, from loud to hardly any noise: 0.04 by chance."""
    refused = 0
    for seed in range(50):
        left = ENDS[seed % 4]
        sizes = ((6, 2), (8, 3), (12, 5))[seed % 3]
        for level in (0.05, 0.01, 1e-3, 1e-5):
            found = refined(left, level=level, seed=seed, n_sensors=sizes[0], n_modes=sizes[1])
            try:
                check_ends(found, told(left), length=LENGTH)
            except ValueError:
                refused += 1
    assert refused <= 1
