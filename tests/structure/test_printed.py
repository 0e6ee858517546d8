"""What results look like when printed: figures of the object, in SI, and never an array."""

from dataclasses import replace

import numpy as np
import pytest

import workbench as wb
from workbench.cases.case import Case
from workbench.design.estimation.controller import filtered
from workbench.design.estimation.modal_filter import filter_on
from workbench.identification.updating.distributions import SelfCheck
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes, PointShapes
from workbench.structure.printed import all_rounded, places_text, warns_of_remarks


@pytest.fixture(scope="module")
def beam():
    return wb.Beam(length=2.0, mass_per_length=1.5, bending_stiffness=3.0, left="clamped", right="free")


@pytest.fixture(scope="module")
def rig(beam):
    sensors = [wb.Sensor("y", 1.5), wb.Sensor("z", 2.0, "velocity")]
    return wb.Rig(beam.modes(3), [wb.Actuator("F", 0.5)], sensors, structure=beam)


@pytest.fixture(scope="module")
def record(rig):
    return wb.simulate(rig, np.ones((1, 500)), sample_time=0.01)


def test_modes_are_a_table_of_frequencies_and_damping(beam):
    text = str(beam.modes(2)).splitlines()
    assert text[0].startswith("2 modes, 0.1978 to 1.24 Hz, on 0 to 2 m")
    assert text[1].split() == ["mode", "frequency", "[Hz]", "damping", "[%]"]
    assert [float(line.split()[1]) for line in text[2:]] == pytest.approx(beam.modes(2).frequencies_hz, rel=1e-5)


def test_a_record_is_a_table_of_channels(record):
    text = str(record).splitlines()
    assert "1 input and 2 outputs, 500 samples at 100 Hz, 5 s" in text[0]
    assert text[2].split()[:6] == ["F", "input", "force", "N", "0.5", "0"]
    assert float(text[3].split()[-1]) == pytest.approx(np.abs(record.outputs[0]).max(), rel=1e-2)


def test_a_rig_shows_what_differs_from_the_defaults(rig):
    """So that a corrected rig does not print as the nominal one."""
    assert str(rig).splitlines()[1].split() == ["name", "quantity", "at", "[m]"]
    late = replace(rig.actuators[0], delay=0.004, gain=0.3, limit=2.0, rate_limit=5.0, direct=True, hysteresis_width=2)
    loud = replace(rig.sensors[1], noise_std=1e-3, crosstalk=(("y", 0.1),), shape_error=(0.01, 0.0, 0.0))
    text = str(replace(rig, actuators=[late], sensors=[rig.sensors[0], loud])).splitlines()
    assert text[1].split() == ["name", "quantity", "at", "[m]", "properties"]
    actuator = "gain 0.3, limit 2 N, delay 0.004 s, direct, hysteresis width 2, rate limit 5 N/s"
    assert text[2].endswith(f"  0.5  {actuator}")
    assert text[3].split() == ["y", "sensor", "displacement", "1.5"]
    assert text[4].endswith("  noise std 0.001 m/s, crosstalk 0.1 of y, shape error")
    leaking = wb.Actuator("G", 0.7, crosstalk=(("F", -0.2),))
    assert str(replace(rig, actuators=[rig.actuators[0], leaking])).splitlines()[3].endswith("  crosstalk -0.2 of F")
    shapes = PointShapes(np.array([[1.0], [0.5]]))
    modes = Modes(omega=[2.0], damping=[[0.1]], shapes=shapes, domain=NamedPoints(("P1", "P2")))
    lagging = wb.Actuator("F", "P1", time_constant=0.02)
    at_points = str(wb.Rig(modes, [lagging], [wb.Sensor("y", "P2")])).splitlines()
    assert at_points[1].split()[2:] == ["at", "properties"] and at_points[2].endswith("P1  time constant 0.02 s")


def test_a_structure_says_its_ends_and_profiles(beam):
    text = str(beam).splitlines()
    assert text[0] == "beam, 2 m, left clamped, right free"
    assert text[2].split() == ["mass", "per", "length", "[kg/m]", "1.5", "1.5", "1.5"]


def test_places_are_parted_by_commas_and_pairs_by_semicolons():
    assert places_text(np.array([0.25, 1.0])) == "0.25, 1"
    assert places_text(np.array(["N1z", "N2z"], object)) == "N1z, N2z"
    assert places_text(np.array([[0.25, 1.0], [0.5, 2.0]])) == "0.25, 1; 0.5, 2"


def test_all_numbers_have_six_digits_or_are_null():
    assert all_rounded(np.array([[1.23456789, np.nan], [np.inf, 2.0]])) == [[1.23457, None], [None, 2.0]]
    assert all_rounded({"a": 0.1234567, "b": -np.inf}) == {"a": 0.123457, "b": None}
    assert (all_rounded(1 / 3), all_rounded([])) == (0.333333, [])


def test_nothing_prints_an_array(beam, rig, record):
    many = NamedPoints(tuple(f"p{i}" for i in range(1000)))
    for result in (beam, rig, record, rig.modes, many, record.select_outputs(["y"])):
        assert len(repr(result)) < 200 and "array(" not in repr(result) + str(result)
        assert len(str(result)) < 1000


def test_what_is_designed_and_checked_prints_no_array():
    points = NamedPoints(tuple(f"S{i}" for i in range(4)))
    frame = wb.FiniteElements(np.eye(4), np.diag([1.0, 2.0, 3.0, 4.0]), nodes=points)
    modes = frame.modes(4)
    law = wb.imsc(modes, 1, [wb.Actuator("F", "S0")], weight=1.0)
    sensors = wb.place_sensors(modes, 1, 2, mean_squares=np.ones(4))
    through = filter_on(None, modes, [0], sensors.positions)
    check = SelfCheck(np.array([0.01, -0.02]), np.array([1.0, 0.9]))
    for result in (frame, sensors, through, filtered(law, through), check):
        assert len(repr(result)) < 200 and "array(" not in repr(result) + str(result)
    assert str(check).splitlines()[2].split() == ["1", "1", "1.0000"] and "largest frequency error 2 %" in str(check)
    assert "4 degrees of freedom at 4 nodes" in repr(frame) and "y1" in str(filtered(law, through))


def test_a_notebook_shows_the_same_table_with_nothing_left_to_run():
    record = wb.Record(0.1, np.zeros((1, 5)), (wb.Channel("<script>"),))
    shown = record._repr_html_()
    assert "<table>" in shown and "<script>" not in shown


def test_a_function_warns_its_caller_of_the_remarks_of_what_it_returns():
    class Found:
        remarks = ("one", "two")

    @warns_of_remarks
    def found_of(number: int) -> Found:
        return Found()

    with pytest.warns(UserWarning) as told:
        assert isinstance(found_of(3), Found)
    assert [(str(w.message), w.filename) for w in told] == [("one", __file__), ("two", __file__)]
    assert found_of.__name__ == "found_of"


def test_parts_print_as_calls_with_what_differs_from_the_defaults():
    assert repr(wb.Sensor("y1", 0.4 / 3.0, noise_std=1e-3)) == "Sensor(name='y1', at=0.133333, noise_std=0.001)"
    assert repr(wb.Actuator("F1", 0.2, limit=3.0)) == "Actuator(name='F1', at=0.2, limit=3)"
    assert repr(wb.Limits(spacing=0.1, forbidden=((0.1, 0.2),))) == "Limits(spacing=0.1, forbidden=((0.1, 0.2),))"
    assert repr(wb.Channel("a", "acceleration", at=0.3)) == "Channel(name='a', quantity='acceleration', at=0.3)"
    assert repr(wb.Channel("F", "force", "lbf")) == "Channel(name='F', quantity='force', unit='lbf')"


def test_a_plate_prints_its_edges_and_the_values_of_its_fields():
    thing = {"length": (1.2, 0.8), "mass_per_area": lambda x, y: 10.0 + x, "bending_stiffness": 100.0}
    sides = {"left": "clamped", "right": "free", "bottom": "simply supported", "top": wb.Edge(5.0, 0.0)}
    lines = str(wb.Plate(**thing, poisson_ratio=0.3, edges=sides)).splitlines()
    around = "left clamped, right free, bottom simply supported, top on springs of 5 N/m² and 0 N"
    assert lines[0] == f"plate, 1.2 by 0.8 m, {around}, Poisson's ratio 0.3"
    assert lines[2].split() == ["mass", "per", "area", "[kg/m²]", "10", "10.6", "11.2"]
    assert lines[3].split() == ["bending", "stiffness", "[N", "m]", "100", "100", "100"]
    membrane = wb.Membrane(length=(1.0, 2.0), mass_per_area=1.0, tension=3.0)
    assert repr(membrane) == "<Membrane: membrane, 1 by 2 m, all edges fixed>"
    assert str(membrane).splitlines()[3].split() == ["tension", "[N/m]", "3", "3", "3"]


def test_a_case_is_a_table_of_its_records(rig, record):
    lines = str(Case("arm", rig, fit=(record,), validation=())).splitlines()
    assert lines[0] == "case 'arm': 3 modes, 1 actuator, 2 sensors, 0 elements"
    assert lines[2].split() == [*record.name.split(), "fit", "500", "100"]
