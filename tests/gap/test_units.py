"""A case in other units, millimetres and tonnes, has the same verdict, its figures converted."""

import re
from dataclasses import replace
from math import isclose, prod

import numpy as np
import pytest

from workbench.cases.case import Case
from workbench.gap.diagnose import diagnose
from workbench.gap.effects.catalogue import CATALOGUE, kind_named
from workbench.gap.effects.effect import Parameter
from workbench.gap.effects.nonlinear import BEYOND
from workbench.records import units as named_units
from workbench.records.record import Record
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Bar, Beam
from workbench.structure.profile import Profile
from workbench.study.pages.verdict_page import verdict_tables
from workbench.trials.make import make_trial

MILLIMETRES, TONNES, MILLISECONDS = 1e3, 1e-3, 1e3  # of a metre, a kilogram and a second
NO_BOUND = 1e12  # times the unit, as (its inverse) at the other end: limits of what is read off records as it is
KINDS = (
    "clearance", "point_mass", "coulomb_friction", "cubic_spring", "bouc_wen", "quadratic_damper", "ground_spring",
    "support_rotation", "midplane_stretching", "actuator_saturation", "actuator_delay", "sensor_bias", "sensor_gain",
)  # fmt: skip


class Units:
    """Other units: what a number in metres, kilograms and seconds is multiplied by."""

    def __init__(self, length: float, mass: float, time: float = 1.0) -> None:
        self.length, self.time, self.line_mass = length, time, mass / length
        self.force = mass * length / time**2
        self.of = {"m": length, "kg": mass, "N": self.force, "s": time, "Hz": 1.0 / time, "rad": 1.0, "": 1.0}

    def factor(self, parameter: Parameter, of_sensor: float) -> float:
        """Of a parameter; a sensor's own unit is not written beside it."""
        if parameter.name in ("bias", "drift_over_record", "limit", "step") and not parameter.unit:
            return of_sensor
        over, _, under = parameter.unit.partition("/")
        return self._product(over.replace("1", "")) / self._product(under)

    def _product(self, text: str) -> float:
        parts = (token.partition("^") for token in re.findall(r"[A-Za-z]+(?:\^\d)?", text))
        return prod(self.of[name] ** int(power or 1) for name, _, power in parts)

    def rig(self, rig: Rig) -> Rig:
        member = rig.structure
        assert isinstance(member, Bar | Beam) and isinstance(member.damping, ModalDamping)
        stiffness, area = ("bending_stiffness", 2) if isinstance(member, Beam) else ("axial_stiffness", 0)
        structure = replace(
            member,
            length=self.length * member.length,
            mass_per_length=self._profile(member.mass_per_length, self.line_mass),
            **{stiffness: self._profile(getattr(member, stiffness), self.force * self.length**area)},
        )
        actuators = tuple(replace(a, at=self.length * a.at) for a in rig.actuators)
        sensors = tuple(replace(s, at=self.length * s.at, noise_std=self.length * s.noise_std) for s in rig.sensors)
        return Rig(structure.modes(rig.modes.n_modes, tolerance=1e-9), actuators, sensors, structure=structure)

    def _profile(self, profile: Profile, factor: float) -> Profile:
        return Profile(lambda x: factor * profile(x / self.length), tuple(self.length * b for b in profile.breaks))

    def record(self, record: Record) -> Record:
        return replace(record, outputs=self.length * record.outputs)


def test_bounds_of_effects_are_relative_to_the_rig():
    beam = Beam(length=2.0, mass_per_length=1.5, bending_stiffness=40.0, left="clamped", right="hinged")
    sensors = [Sensor(f"y{i}", 0.3 * i + 0.2, noise_std=1e-5) for i in range(4)]
    rig = Rig(beam.modes(5, tolerance=1e-9), [Actuator("F1", 0.7), Actuator("F2", 1.1)], sensors, structure=beam)
    units = Units(MILLIMETRES, TONNES, MILLISECONDS)
    converted = units.rig(rig)
    wrong = []
    kinds = [kind for kind in (*CATALOGUE, *BEYOND) if kind.targets(rig)]
    for kind in kinds:
        target = kind.targets(rig)[0]
        pairs = zip(kind.parameters(rig, target), kind.parameters(converted, target), strict=True)
        for one, other in pairs:
            factor = units.factor(one, units.length)
            for end in ("low", "high"):
                before, after = getattr(one, end), getattr(other, end)
                unbounded = before == after and (abs(before) >= NO_BOUND or abs(before) <= 1.0 / NO_BOUND)
                if not unbounded and not isclose(after, factor * before, rel_tol=1e-9):
                    wrong.append(f"{kind.name}, {one.name}: {end} {before:g} {one.unit} becomes {after:g}")
    assert not wrong, wrong
    assert {kind.name for kind in CATALOGUE} - {kind.name for kind in kinds} == {"joint_slip"}  # between named points


def test_a_verdict_tells_its_numbers_by_the_names_of_the_units(hinged_rig, record_of):
    rig, rng = hinged_rig(3), np.random.default_rng(5)
    real = kind_named("point_mass").apply(rig, None, {"at": 0.6, "mass": 0.5})
    record = record_of(real, np.repeat(rng.normal(size=40), 10)[None], rng, name="high")
    millimetres = named_units.Units("mm", "t", "s", "N")
    verdict = diagnose(rig, (record,), catalogue=(kind_named("point_mass"),), workers=1, units=millimetres)
    assert re.search(r"mass 0\.5\S* (± \S+ )?t\)", verdict.sentence) and verdict.to_json()["units"]["length"] == "mm"
    assert verdict_tables(verdict.to_json())[0][1][4] == "position [mm]"
    assert " kg)" in replace(verdict, units=named_units.SI).sentence


def verdict_on(case: Case, rig: Rig, fit: tuple[Record, ...], validation: tuple[Record, ...]) -> dict:
    return diagnose(rig, fit, validation=validation, name=case.name, workers=1).to_json()


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_verdict_is_the_same_in_any_units(kind):
    units = Units(MILLIMETRES, TONNES)
    case, _ = make_trial(12, kinds=(kind,))
    plain = verdict_on(case, case.rig, case.fit, case.validation)
    fit, validation = (tuple(map(units.record, records)) for records in (case.fit, case.validation))
    converted = verdict_on(case, units.rig(case.rig), fit, validation)
    assert [e["kind"] for e in plain["effects"]] == [e["kind"] for e in converted["effects"]] == [kind]
    (one,), (other,) = plain["effects"], converted["effects"]
    if one.get("at") is not None:
        assert other["at"] == pytest.approx(units.length * one["at"], rel=2e-3)
    assert set(other["parameters"]) == set(one["parameters"])
    target = kind_named(kind).targets(case.rig)[0]
    for parameter in kind_named(kind).parameters(case.rig, target):
        if parameter.name in one["parameters"]:
            expected = units.factor(parameter, units.length) * one["parameters"][parameter.name]
            assert other["parameters"][parameter.name] == pytest.approx(expected, rel=0.02), parameter.name
    assert converted["budget"]["unexplained"] == pytest.approx(plain["budget"]["unexplained"], abs=0.005)
