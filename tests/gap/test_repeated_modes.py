"""Repeated modes have no shapes of their own: a diagnosis must not depend on the basis that is taken of them."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.gap.diagnose import diagnose
from workbench.gap.effects.catalogue import kind_named
from workbench.gap.localisation.force_location import locate_force
from workbench.gap.localisation.force_reconstruction import ForceReconstruction
from workbench.gap.prediction.residuals import FitData
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.damping import ModalDamping

DT, SAMPLES, NOISE, RATIO, ANGLE = 0.01, 600, 1e-5, 0.01, 0.7
SPRING = {"x": 0.61, "y": 0.27, "stiffness": 2e5}
SEES = ((0.22, 0.31), (0.55, 0.18), (0.71, 0.64), (0.35, 0.77))


def rig_of(modes, plate):
    sensors = tuple(Sensor(f"w{i + 1}", at, noise_std=NOISE) for i, at in enumerate(SEES))
    modes = replace(modes, damping=np.full(modes.n_modes, RATIO))
    return Rig(modes, (Actuator("F", (0.3, 0.4)),), sensors, structure=replace(plate, damping=ModalDamping(RATIO)))


@pytest.fixture(scope="module")
def records(square_plate, turned_modes):
    """What the plate with a cubic spring does, at three levels."""
    real = kind_named("cubic_spring").apply(rig_of(turned_modes(0.0), square_plate), None, SPRING)
    rng, found = np.random.default_rng(2), []
    for name, level in (("low", 1.0), ("high", 6.0), ("check", 4.0)):
        clean = simulate(real, level * rng.normal(size=(1, SAMPLES)), sample_time=DT, substeps=16, name=name)
        found.append(replace(clean, outputs=clean.outputs + NOISE * rng.normal(size=clean.outputs.shape)))
    return found


def test_prediction_and_place_of_the_force_do_not_depend_on_the_basis(square_plate, turned_modes, records):
    data = FitData(tuple(records[:2]), np.full(len(SEES), NOISE))
    rigs = [rig_of(turned_modes(angle), square_plate) for angle in (0.0, ANGLE)]
    assert not np.allclose(*(rig.modes.phi((0.3, 0.4)) for rig in rigs))
    left, turned = (data.residual(rig) for rig in rigs)
    assert np.abs(left).max() > 100.0
    np.testing.assert_allclose(turned, left, atol=1e-9 * np.abs(left).max())
    corrected, turned = (data.residual(kind_named("cubic_spring").apply(rig, None, SPRING)) for rig in rigs)
    np.testing.assert_allclose(turned, corrected, atol=1e-6)
    places = [locate_force(ForceReconstruction.of(rig, data)) for rig in rigs]
    assert places[1].at == pytest.approx(places[0].at, abs=1e-5)
    assert places[0].at == pytest.approx((SPRING["x"], SPRING["y"]), abs=0.02)
    assert places[1].at_std == pytest.approx(places[0].at_std, rel=1e-2)


@pytest.mark.slow
def test_the_verdict_does_not_depend_on_the_basis(square_plate, turned_modes, records):
    verdicts = [
        diagnose(rig_of(turned_modes(angle), square_plate), records[:2], validation=records[2:], name="plate")
        for angle in (0.0, ANGLE)
    ]
    one, other = (verdict.effects for verdict in verdicts)
    assert [[effect.kind.name for effect in effects] for effects in (one, other)] == [["cubic_spring"]] * 2
    for name, true in SPRING.items():
        assert other[0].values[name] == pytest.approx(one[0].values[name], rel=1e-4)
        assert one[0].values[name] == pytest.approx(true, rel=0.01)
    for figures in ("gap", "budget", "shrinkage"):
        one, other = (verdict.to_json()[figures] for verdict in verdicts)
        assert flat(other) == pytest.approx(flat(one), rel=1e-3, abs=1e-6), figures


def flat(figures):
    """All numbers of nested tables and lists."""
    if isinstance(figures, dict | list):
        return [
            number for part in (figures.values() if isinstance(figures, dict) else figures) for number in flat(part)
        ]
    return [figures]
