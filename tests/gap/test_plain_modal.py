"""A rig known by plain modal data alone: one degree of freedom whose spring hardens, integrated by scipy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from workbench.cases.case import read_case
from workbench.cases.writing import write_case
from workbench.draw.gap import plot_unmodelled_force, plot_where
from workbench.gap.diagnose import diagnose

MASS, DAMPING, STIFFNESS, CUBIC = 2.0, 1.6, 800.0, 4e5
DT, SAMPLES, NOISE = 0.005, 800, 2e-5
CASE = f"""
[structure]
kind = "modal"
mass = {MASS}
damping = {DAMPING}
stiffness = {STIFFNESS}
[[input]]
name = "F"
kind = "actuator"
[[output]]
name = "w"
quantity = "displacement"
noise_std = {NOISE}
"""
RECORD = '[[record]]\nname = "{0}"\nfile = "records/{0}.npz"\nsample_time = {1}\nuse = "{2}"\n'


def hardening(u):
    """Displacement of m w'' + c w' + k w + k3 w³ = u, u held over each sample."""
    state, found = np.zeros(2), np.zeros(u.size)
    for i in range(u.size - 1):

        def motion(_, x, force=u[i]):
            return [x[1], (force - DAMPING * x[1] - STIFFNESS * x[0] - CUBIC * x[0] ** 3) / MASS]

        state = solve_ivp(motion, (0.0, DT), state, method="DOP853", rtol=1e-9, atol=1e-13).y[:, -1]
        found[i + 1] = state[0]
    return found


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("seat")
    (folder / "records").mkdir()
    rng, text = np.random.default_rng(3), CASE
    for name, level in (("low", 1.0), ("high", 8.0), ("validate", 5.0)):
        u = level * np.repeat(rng.normal(size=SAMPLES // 5), 5)
        w = hardening(u) + NOISE * rng.normal(size=SAMPLES)
        np.savez(folder / f"records/{name}.npz", t=DT * np.arange(SAMPLES), F=u, w=w)
        text += RECORD.format(name, DT, "validate" if name == "validate" else "fit")
    (folder / "case.toml").write_text(text)
    return read_case(folder)


@pytest.mark.slow
def test_noise_that_is_not_stated_is_taken_from_the_records(case, tmp_path):
    folder = tmp_path / "silent"
    write_case(case, folder)
    text = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text("\n".join(line for line in text.splitlines() if "noise_std" not in line))
    silent = read_case(folder)
    assert silent.rig.sensors[0].noise_std == 0.0
    verdict = diagnose(silent.rig, silent.fit, validation=silent.validation)
    assert [effect.label for effect in verdict.effects] == ["cubic_spring"]
    assert verdict.budget.noise_found[0] == pytest.approx(NOISE, rel=0.2)
    assert any("noise_std of w is not stated" in note for note in verdict.notes)


def test_a_hardening_spring_is_named_at_the_input_where_it_stands(case):
    verdict = diagnose(case.rig, case.fit, validation=case.validation, name=case.name)
    assert [effect.label for effect in verdict.effects] == ["cubic_spring"]
    assert verdict.effects[0].values["stiffness"] == pytest.approx(CUBIC, rel=1e-3)
    assert verdict.shrinkage.overall > 0.99
    assert " at F " in verdict.sentence and "x =" not in verdict.sentence
    labels = [text.get_text() for text in plot_where(verdict).axes[5].get_xticklabels()]
    assert labels == ["F", "w"]
    left, right = plot_unmodelled_force(verdict, length="V", force="V").axes
    assert "at F" in left.get_xlabel()
    assert left.get_xlabel() == "displacement at F [V]" and right.get_xlabel() == "velocity at F [V/s]"
    assert left.get_ylabel() == "unmodelled force [V]"
