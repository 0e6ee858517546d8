"""A drive whose friction varies along its rail, integrated here: no law of the catalogue leaves noise alone."""

import numpy as np
import pytest

from workbench.gap.diagnose import diagnose
from workbench.records.record import Channel, Record
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes, PointShapes

MASS, VISCOUS, FRICTION, OFFSET = 95.0, 200.0, 20.0, 3.0  # kg, N s/m, N, N
ALONG_THE_RAIL = 0.1  # share by which friction varies, every 0.1 m
SAMPLE_TIME, N_SAMPLES, FINE, NOISE = 0.01, 800, 50, 1e-4


def nominal(quantity):
    """A mass on a rail with viscous friction alone."""
    shapes = PointShapes(np.full((2, 1), MASS**-0.5))
    modes = Modes(omega=[0.0], damping=[[VISCOUS / MASS]], shapes=shapes, domain=NamedPoints(("drive", "carriage")))
    return Rig(modes, (Actuator("drive", "drive"),), (Sensor("carriage", "carriage", quantity, noise_std=NOISE),))


def stroke(quantity, amplitude, name, rng):
    """Forces that move the carriage to and fro, in fifty steps a sample."""
    time = np.arange(N_SAMPLES) * SAMPLE_TIME
    force = amplitude * np.sin(2.0 * np.pi * 0.3 * time) + 0.4 * amplitude * np.sin(2.0 * np.pi * 0.83 * time + 1.0)
    x = v = 0.0
    step, moved = SAMPLE_TIME / FINE, []
    for u in force:
        moved.append(x if quantity == "displacement" else v)
        for _ in range(FINE):
            pushed = v + step * (u + OFFSET - VISCOUS * v) / MASS
            most = step * FRICTION * (1.0 + ALONG_THE_RAIL * np.sin(2.0 * np.pi * x / 0.1)) / MASS
            v = 0.0 if abs(pushed) <= most else pushed - most * np.sign(pushed)
            x += step * v
    outputs = np.array(moved)[None] + NOISE * rng.standard_normal((1, force.size))
    return Record(
        sample_time=SAMPLE_TIME,
        outputs=outputs,
        output_channels=(Channel("carriage", quantity),),
        inputs=force[None],
        input_channels=(Channel("drive", "force"),),
        name=name,
    )


@pytest.mark.slow
@pytest.mark.parametrize("quantity", ["velocity", "displacement"])
def test_dry_friction_and_a_constant_force_are_named_in_one_form_and_the_other_not_excluded(quantity):
    """Friction that differs between the directions is friction and a constant force, number for number."""
    rng = np.random.default_rng(1)
    fitted, held_out = (stroke(quantity, size, f"{size:g} N", rng) for size in (60.0, 75.0))
    verdict = diagnose(nominal(quantity), (fitted,), validation=(held_out,), uncertain_nominal=True)
    assert verdict.outcome == "explained"
    told = {effect.kind.name: effect.values for effect in verdict.effects if not effect.kind.applied_first}
    assert set(told) in ({"coulomb_friction", "actuator_bias"}, {"two_way_friction"})
    if "two_way_friction" in told:
        one, other = (told["two_way_friction"][f"force_{way}"] for way in ("forward", "backward"))
        friction, offset = 0.5 * (one + other), 0.5 * (other - one)
    else:
        friction, offset = told["coulomb_friction"]["force"], told["actuator_bias"]["force"]
    assert friction == pytest.approx(FRICTION, rel=0.1) and offset == pytest.approx(OFFSET, rel=0.3)
    assert not any("bouc_wen" in kind for kind, _ in verdict.alternatives)
    assert verdict.budget.unexplained < 0.01
    if quantity == "velocity":
        assert set(told) == {"two_way_friction"} and "a constant force of an actuator (drive) cannot be excluded" in (
            verdict.sentence
        )
