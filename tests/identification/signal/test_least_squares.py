"""The least-squares engine on a certified problem of NIST's Statistical Reference Datasets (Misra1a, lower
difficulty)."""

import numpy as np
import pytest

from workbench.identification.signal.searches import TimeLimit, minimise

Y = [10.07, 14.73, 17.94, 23.93, 29.61, 35.18, 40.02, 44.82, 50.76, 55.05, 61.01, 66.40, 75.47, 81.78]
X = [77.6, 114.9, 141.1, 190.8, 239.9, 289.0, 332.8, 378.4, 434.8, 477.3, 536.8, 593.1, 689.1, 760.0]
CERTIFIED, SQUARES = (2.3894212918e02, 5.5015643181e-04), 1.2455138894e-01


class Misra:
    """y = b_1 (1 - e^{-b_2 x}), b_2 in units of `unit`."""

    def __init__(self, unit=1.0):
        self.x, self.y, self.unit = np.array(X), np.array(Y), unit

    def residual(self, b):
        return self.y - b[0] * -np.expm1(-self.unit * b[1] * self.x)

    def cost(self, b):
        return float((self.residual(b) ** 2).sum())

    def normal_equations(self, b):
        fade = np.exp(-self.unit * b[1] * self.x)
        slopes = np.column_stack([1.0 - fade, b[0] * self.unit * self.x * fade])
        return slopes.T @ slopes, slopes.T @ self.residual(b)

    def moved(self, b, step):
        return (b + step if b[0] + step[0] > 0 else None), step

    def negligible(self, decrease, cost):
        return decrease < 1e-14 * cost


@pytest.mark.parametrize("start", [(500.0, 1e-4), (250.0, 5e-4)])
def test_certified_values(start):
    found = minimise(Misra(), np.array(start), most_steps=100)
    assert found.converged and found.cost == pytest.approx(SQUARES, rel=1e-9)
    assert found.state == pytest.approx(CERTIFIED, rel=1e-7)


def test_units_do_not_matter():
    one, other = (minimise(Misra(unit), np.array([500.0, 1e-4 / unit]), most_steps=100) for unit in (1.0, 1e-6))
    assert one.steps == other.steps
    assert other.state[1] * 1e-6 == pytest.approx(one.state[1], rel=1e-9)


def test_time_that_is_up_ends_the_search_and_is_noted():
    time_limit = TimeLimit(1e-9)
    found = minimise(Misra(), np.array([500.0, 1e-4]), most_steps=100, time_limit=time_limit)
    assert found.steps == 1 and not found.converged and found.cost < Misra().cost((500.0, 1e-4))
    assert [*time_limit.unfinished] == ["refinement"] and "allow more time" in time_limit.remarks[0]


def test_a_search_that_is_in_vain_ends():
    whole, start = minimise(Misra(), np.array([500.0, 1e-4]), most_steps=100), np.array([500.0, 1e-4])
    ended = minimise(Misra(), start, most_steps=100, is_vain=lambda b: b[0] < 450.0)
    assert ended.steps < whole.steps and not ended.converged
    assert CERTIFIED[0] < ended.state[0] < 450.0
