"""Errors of a nominal model, beside effects."""

from dataclasses import replace

import numpy as np

from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import NominalPrior, nominal_errors
from workbench.rig.rig import shape_of


def test_an_exchanged_sensor_that_is_off_its_place_stays_on_the_structure(hinged_rig):
    rig = hinged_rig(n_modes=3)
    length = rig.modes.domain.size
    rig = replace(rig, sensors=(*rig.sensors[:3], replace(rig.sensors[3], at=length)))
    errors = nominal_errors(rig, NominalPrior(place=0.001))
    errors = replace(errors, values=dict.fromkeys(errors.values, 0.002))
    exchanged = Effect(kind_named("swapped_outputs"), ("d1", "d4"), {})
    off = apply_all(rig, (exchanged, errors))
    assert np.isfinite([shape_of(off.modes, sensor) for sensor in off.sensors]).all()
    assert sorted(sensor.at for sensor in off.sensors)[-1] == length


def test_errors_stay_where_they_are_when_their_size_is_learnt_to_be_smaller(hinged_rig):
    """Else a rig that bears a load by them would buckle."""
    rig = hinged_rig(n_modes=3)
    before = nominal_errors(rig, NominalPrior(stiffness=0.02), {"stiffness_1": 0.15})
    assert nominal_errors(rig, replace(before.target, stiffness=0.01), before.values).values == before.values
