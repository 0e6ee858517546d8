"""The order of the tests, the beam that most of their rigs are built on, and a plate with repeated modes."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam
from workbench.structure.modes import Modes
from workbench.structure.plate import Plate


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Whole studies first: they are the longest, and two workers then end together."""
    items.sort(key=lambda item: item.path.name != "test_studies.py")


@pytest.fixture(scope="session")
def hinged_beam() -> Beam:
    """Its frequencies are π r²/4 Hz: 0.785, 3.14, 7.07, ..."""
    return Beam(
        length=2.0,
        mass_per_length=1.0,
        bending_stiffness=4.0,
        left="hinged",
        right="hinged",
        damping=ModalDamping(0.01),
    )


@pytest.fixture(scope="session")
def square_plate() -> Plate:
    """Undamped; its modes 2 and 3 are repeated, and 5 and 6; ω = 2 π², 5 π², 5 π², 8 π², 10 π², 10 π² rad/s."""
    return Plate(
        length=(1, 1),
        mass_per_area=1,
        bending_stiffness=1,
        poisson_ratio=0.3,
        edges="simply supported",
    )


@pytest.fixture(scope="session")
def turned_modes(square_plate: Plate) -> Callable[[float], Modes]:
    """Its lowest six modes, of whose repeated modes 2 and 3 another basis is taken: both turned by an angle."""
    modes = square_plate.modes(6)
    assert modes.omega[1] == pytest.approx(modes.omega[2], rel=1e-12)

    def make(angle: float) -> Modes:
        turn = np.eye(6)
        turn[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        return replace(modes, shapes=lambda at, derivative: modes.shapes(at, derivative) @ turn)

    return make
