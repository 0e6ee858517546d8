"""A case in millimetres and tonnes has the verdict of the same case in metres and kilograms, converted."""

from dataclasses import replace

import pytest

from workbench.cases.case import Case
from workbench.gap.diagnose import diagnose
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.structure.member import Bar, Beam
from workbench.structure.profile import Profile
from workbench.trials.make import make_trial

LENGTH, MASS = 1e3, 1e-3  # of a metre and a kilogram, in the new units: a newton stays a newton
FACTORS = {
    "stiffness": 1.0 / LENGTH,
    "gap": LENGTH,
    "force": 1.0,
    "smoothing_speed": LENGTH,
    "coefficient": 1.0 / LENGTH,
    "mass": MASS,
    "gain": 1.0,
}


def _converted(profile: Profile, factor: float) -> Profile:
    return Profile(lambda x: factor * profile(x / LENGTH), tuple(LENGTH * b for b in profile.breaks))


def in_millimetres(rig: Rig) -> Rig:
    member = rig.structure
    assert isinstance(member, Bar | Beam)
    stiffness = "bending_stiffness" if isinstance(member, Beam) else "axial_stiffness"
    structure = replace(
        member,
        length=LENGTH * member.length,
        mass_per_length=_converted(member.mass_per_length, MASS / LENGTH),
        **{stiffness: _converted(getattr(member, stiffness), LENGTH**2 if isinstance(member, Beam) else 1.0)},
    )
    actuators = tuple(replace(a, at=LENGTH * a.at) for a in rig.actuators)
    sensors = tuple(replace(s, at=LENGTH * s.at, noise_std=LENGTH * s.noise_std) for s in rig.sensors)
    return Rig(structure.modes(rig.modes.n_modes, tolerance=1e-9), actuators, sensors, structure=structure)


def of_millimetres(record: Record) -> Record:
    return replace(record, outputs=LENGTH * record.outputs)


def verdict_on(case: Case, rig: Rig, fit: tuple[Record, ...], validation: tuple[Record, ...]) -> dict:
    return diagnose(rig, fit, validation=validation, name=case.name, workers=1).to_json()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["clearance", "point_mass", "coulomb_friction"])
def test_the_verdict_is_the_same_in_any_units(kind):
    case, _ = make_trial(12, kinds=(kind,))
    plain = verdict_on(case, case.rig, case.fit, case.validation)
    fit, validation = (tuple(map(of_millimetres, records)) for records in (case.fit, case.validation))
    converted = verdict_on(case, in_millimetres(case.rig), fit, validation)
    assert [e["kind"] for e in plain["effects"]] == [e["kind"] for e in converted["effects"]] == [kind]
    (one,), (other,) = plain["effects"], converted["effects"]
    assert other["at"] == pytest.approx(LENGTH * one["at"], rel=2e-3)
    for name, value in one["parameters"].items():
        assert other["parameters"][name] == pytest.approx(FACTORS[name] * value, rel=0.02), name
    assert converted["budget"]["unexplained"] == pytest.approx(plain["budget"]["unexplained"], abs=0.005)
