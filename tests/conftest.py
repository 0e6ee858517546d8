"""The order of the tests, and the beam that most of their rigs are built on."""

import pytest

from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam


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
