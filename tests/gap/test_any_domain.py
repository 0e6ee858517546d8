"""One beam, described along an interval, at 200 named points and by finite elements: one verdict."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.gap.diagnose import diagnose
from workbench.gap.effects.catalogue import kind_named
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import NamedPoints
from workbench.structure.member import Beam
from workbench.structure.modes import Modes, PointShapes

DT, NOISE, DAMPING, N_MODES = 0.1, 0.01, ModalDamping(0.01), 5
AT, STIFFNESS = 6.3, 0.3


def name_at(x):
    return f"w{20 * x:.0f}"


def rig_of(modes, name, structure=None):
    sensors = tuple(Sensor(f"d{i + 1}", name(x), noise_std=NOISE) for i, x in enumerate((1.5, 3.5, 5.5, 8.0)))
    return Rig(modes, (Actuator("F", name(2.0)),), sensors, structure=structure)


@pytest.mark.slow
def test_a_beam_has_one_verdict_along_an_interval_at_named_points_and_as_elements(beam_elements):
    """Place and stiffness to the discretisation error of 200 elements, which is below 1e-5 of the stiffness."""
    beam = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged", damping=DAMPING)
    along, x = beam.modes(N_MODES), np.linspace(0.0, 10.0, 201)[1:-1]
    points = NamedPoints(tuple(map(name_at, x)), np.column_stack([x, np.zeros((199, 2))]), ("y",) * 199)
    named = Modes(along.omega, along.damping, PointShapes(along.phi(x)), points)
    rigs = [
        rig_of(along, float, beam),
        rig_of(named, name_at),
        rig_of(beam_elements(damping=DAMPING).modes(N_MODES), name_at),
    ]
    real = kind_named("cubic_spring").apply(rigs[0], None, {"at": AT, "stiffness": STIFFNESS})
    rng, records = np.random.default_rng(0), []
    for name, level in (("low", 0.3), ("high", 1.5), ("check", 1.0)):
        force = level * np.repeat(rng.normal(size=(1, 200)), 4, axis=1)
        clean = simulate(real, force, sample_time=DT, substeps=64, name=name)
        records.append(replace(clean, outputs=clean.outputs + NOISE * rng.normal(size=clean.outputs.shape)))
    verdicts = [diagnose(rig, records[:2], validation=records[2:]) for rig in rigs]
    for verdict in verdicts:
        assert verdict.outcome == "explained" and [e.kind.name for e in verdict.effects] == ["cubic_spring"]
        assert verdict.shrinkage.overall > 0.99
    first, *others = (verdict.effects[0].values for verdict in verdicts)
    assert first["at"] == pytest.approx(AT, abs=1e-3) and first["stiffness"] == pytest.approx(STIFFNESS, rel=1e-3)
    for other in others:
        assert other["at"] == name_at(AT)
        assert other["stiffness"] == pytest.approx(first["stiffness"], rel=1e-5)
