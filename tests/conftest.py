"""One core a worker, the order of the tests, a hinged beam, the same by elements, a plate."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from workbench.structure.damping import Damping, ModalDamping
from workbench.structure.domain import NamedPoints
from workbench.structure.finite_elements import FiniteElements
from workbench.structure.member import Beam
from workbench.structure.modes import Modes
from workbench.structure.plate import Plate

if "PYTEST_XDIST_WORKER" in os.environ:
    # One worker a core; inner functions that tests call do not limit threads. What would share its work with processes
    # on other cores would wait for those of other workers
    threadpool_limits(1, user_api="blas")
    os.environ["LOKY_MAX_CPU_COUNT"] = "1"


HERE = Path(__file__).parent
# Rooms that ask little of compiled code: where there is none yet, one worker compiles while the other tests these, and
# neither compiles what the other does.
HARDLY_COMPILED = ("identification", "records", "structure", "study", "hard_use")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Whole studies first, which are the longest; two workers take a half each, and then from one another."""

    def place(item: pytest.Item) -> int:
        room = item.path.relative_to(HERE).parts[0]
        if room == "test_studies.py":
            return 0
        return 2 + HARDLY_COMPILED.index(room) if room in HARDLY_COMPILED else 1 if (HERE / room).is_dir() else 9

    items.sort(key=place)


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
def beam_elements() -> Callable[..., FiniteElements]:
    """A uniform beam of 10 m, m = EI = 1, of n Hermite elements of scikit-fem: points w0, r0, w1, r1, ..."""
    from skfem import Basis, BilinearForm, ElementLineHermite, MeshLine
    from skfem.helpers import dd

    @BilinearForm
    def bending(u, v, _):
        return dd(u)[0, 0] * dd(v)[0, 0]

    @BilinearForm
    def inertia(u, v, _):
        return u * v

    def make(n: int = 200, *, hinged: bool = True, damping: Damping | None = None) -> FiniteElements:
        x = np.linspace(0.0, 10.0, n + 1)
        basis = Basis(MeshLine(x), ElementLineHermite())
        order = basis.nodal_dofs.T.ravel()
        kept = np.setdiff1d(np.arange(order.size), [0, 2 * n]) if hinged else np.arange(order.size)
        names = [kind + str(i) for i in range(n + 1) for kind in "wr"]
        positions = np.column_stack([np.repeat(x, 2), np.zeros((order.size, 2))])
        points = NamedPoints(
            tuple(names[i] for i in kept),
            positions[kept],
            tuple(("y", "rz")[i % 2] for i in kept),
            tuple(str(i // 2) for i in kept),
        )
        matrices = (form.assemble(basis).tocsc()[order][:, order] for form in (inertia, bending))
        mass, stiffness = (matrix[kept][:, kept] for matrix in matrices)
        return FiniteElements(mass, stiffness, nodes=points, damping=damping)

    return make


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
