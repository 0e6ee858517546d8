"""The beam of the dissertation's Chapter 5."""

from collections.abc import Callable
from functools import cache

import pytest

from workbench.structure.member import Beam
from workbench.structure.modes import Modes


@pytest.fixture(scope="session")
def hinged_modes() -> Callable[[int], Modes]:
    """The lowest modes of a uniform hinged beam of 10 m, m = EI = 1: ω_r = (r π / 10)²."""
    beam = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged")
    return cache(beam.modes)
