"""A mass on a rail, known by its mass and viscous friction alone: the dry friction that it lacks is found."""

import numpy as np
import pytest

from workbench.cases.case import read_case
from workbench.gap.diagnose import diagnose

MASS, VISCOUS, DRY, SMOOTHING = 95.0, 200.0, 20.0, 1e-3
DT, SAMPLES, FINE, NOISE = 0.01, 1500, 200, 1e-4
CASE = f"""
[structure]
kind = "modal"
mass = {MASS}
damping = {VISCOUS}
stiffness = 0.0
[[input]]
name = "F"
kind = "actuator"
[[output]]
name = "v"
quantity = "velocity"
noise_std = {NOISE}
"""
RECORD = '[[record]]\nname = "{0}"\nfile = "{0}.npz"\nsample_time = {1}\nuse = "{2}"\n'


def sliding(u):
    """Velocity of m v' + c v + F tanh(v / v_s) = u, u held, by fourth-order Runge-Kutta."""

    def slope(v, force):
        return (force - VISCOUS * v - DRY * np.tanh(v / SMOOTHING)) / MASS

    v, found, h = 0.0, np.zeros(u.size), DT / FINE
    for k in range(u.size - 1):
        for _ in range(FINE):
            a = slope(v, u[k])
            b = slope(v + 0.5 * h * a, u[k])
            c = slope(v + 0.5 * h * b, u[k])
            v += h / 6.0 * (a + 2.0 * b + 2.0 * c + slope(v + h * c, u[k]))
        found[k + 1] = v
    return found


@pytest.mark.slow
def test_dry_friction_of_a_mass_without_a_spring_is_found(tmp_path):
    rng, text = np.random.default_rng(4), CASE
    for name, level in (("low", 60.0), ("high", 120.0), ("validate", 90.0)):
        u = level * np.repeat(rng.normal(size=SAMPLES // 20), 20)
        v = sliding(u) + NOISE * rng.normal(size=SAMPLES)
        np.savez(tmp_path / f"{name}.npz", t=DT * np.arange(SAMPLES), F=u, v=v)
        text += RECORD.format(name, DT, "validate" if name == "validate" else "fit")
    (tmp_path / "case.toml").write_text(text)
    case = read_case(tmp_path)
    verdict = diagnose(case.rig, case.fit, validation=case.validation, name="rail")
    assert [effect.kind.name for effect in verdict.effects] == ["coulomb_friction"]
    assert verdict.effects[0].values["force"] == pytest.approx(DRY, rel=0.01)
