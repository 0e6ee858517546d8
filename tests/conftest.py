"""The beam that most rigs of the tests are built on."""

import pytest

from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam


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
