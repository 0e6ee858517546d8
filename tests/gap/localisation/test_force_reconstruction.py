"""Where a missing force may be, before any effect is guessed."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.gap.effects.effect import ForceAndMotion
from workbench.gap.localisation.force_reconstruction import ForceReconstruction
from workbench.gap.prediction.residuals import FitData
from workbench.rig.actuators import Actuator
from workbench.rig.elements import CubicSpring
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.domain import Between, NamedPoints
from workbench.structure.modes import Modes, PointShapes


def test_pairs_of_points_that_move_alike_do_not_crowd_out_others():
    """Five floors of three points each, all of a floor moving as one: nine pairs for every two floors."""
    rng = np.random.default_rng(4)
    floors = rng.standard_normal((5, 4))
    names = tuple(f"{end}{floor}" for floor in range(5) for end in "abc")
    points = NamedPoints(names, rng.standard_normal((15, 3)), ("x",) * 15)
    modes = Modes([20.0, 33.0, 51.0, 70.0], [0.01] * 4, PointShapes(np.repeat(floors, 3, axis=0)), points)
    sensors = tuple(Sensor(f"a{i}", f"a{i}", "acceleration", noise_std=0.02) for i in range(5))
    rig = Rig(modes, (Actuator("F", "b1"),), sensors)
    real = replace(rig, elements=(CubicSpring(Between("a0", "a3"), 300.0),))
    clean = simulate(real, 5.0 * rng.standard_normal((1, 1500)), sample_time=0.01, name="one")
    noisy = replace(clean, outputs=clean.outputs + 0.02 * rng.standard_normal(clean.outputs.shape))
    reconstruction = ForceReconstruction.of(rig, FitData((noisy,), np.full(5, 0.02)))
    pairs = [{int(name[1]) for name in where} for where in reconstruction.peaks if isinstance(where, Between)]
    assert {0, 3} in pairs
    assert len({frozenset(pair) for pair in pairs}) == len(pairs) == 10  # every two floors once


def test_the_strength_of_a_law_is_told_although_errors_have_taken_its_linear_part():
    """Friction less the damping that errors of the model put in its place, and more: alone it points the other way."""
    time = np.linspace(0.0, 20.0, 4000)
    swing = np.exp(-0.05 * time)
    motion = [swing * np.sin(7.0 * time), 7.0 * swing * np.cos(7.0 * time), -49.0 * swing * np.sin(7.0 * time)]
    law = np.tanh(motion[1] / 0.3)
    force = -2.0 * law + 1.4 * (2.0 * (law @ motion[1]) / (motion[1] @ motion[1])) * motion[1] + 0.3 * motion[0]
    alone, absorbed = (ForceAndMotion(0.4, force, *motion, absorbed=absorbed) for absorbed in (False, True))
    assert alone.strength_along(law) < 0.0
    assert absorbed.strength_along(law) == pytest.approx(2.0, rel=1e-9)
