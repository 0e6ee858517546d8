"""Simulations are equal to the last digit in every installation."""

import os
import subprocess
import sys

import numpy as np
import pytest

from workbench.rig.lanes import LANES, on_lanes, row_times

# Compiles some functions of a simulation, which another process then takes from the cache
SOME = """
import numpy as np
from workbench.rig import force_laws, linear, stepping
force_laws.hysteresis(np.arange(5.0), 1.0)
one, of_one = np.ones((1, 8)), lambda: (np.empty((2, 4, 8)), np.zeros((1, 1)), np.zeros((1, 1)))
linear.propagators(one[0], one[0], 0.1, np.empty((2, 4, 8)))
stepping.drifted_propagators(one[0], one[0], 0.1, 1.0, (np.array([1]), one, np.ones((1, 3))), of_one(), of_one())
"""
SIMULATE = """
import numpy as np, workbench as wb
from workbench.rig.elements import BoucWen, CubicSpring
beam = wb.Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged")
elements = CubicSpring(4.1, 3.0), BoucWen(7.3, 0.5, 0.05)
rig = wb.Rig(beam.modes(6), (wb.Actuator("F", 2.0),), (wb.Sensor("y", 3.1),), elements)
force = np.random.default_rng(0).normal(size=(1, 500))
print(wb.simulate(rig, force, sample_time=0.1).outputs.tobytes().hex())
"""


def test_a_row_times_a_vector_is_summed_by_lanes_in_a_fixed_order():
    rng = np.random.default_rng(0)
    for n in (3, 8, 21, 40):
        matrix, x = on_lanes(rng.normal(size=(4, n))), on_lanes(rng.normal(size=n))
        for i in range(4):
            total = np.zeros(LANES)
            for one, other in zip(matrix[i].reshape(-1, LANES), x.reshape(-1, LANES), strict=True):
                total = total + one * other
            while total.size > 1:
                total = total[::2] + total[1::2]
            assert row_times(matrix, i, x) == total[0]


@pytest.mark.slow  # compiles twice
def test_a_simulation_does_not_depend_on_what_was_compiled_before(tmp_path):
    def run(script: str, cache: str) -> str:
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / cache)}
        done = subprocess.run(
            [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
        )
        return done.stdout

    run(SOME, "some compiled before")
    assert run(SIMULATE, "some compiled before") == run(SIMULATE, "all compiled at once") != ""
