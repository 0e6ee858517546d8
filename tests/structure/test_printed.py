"""What results look like when printed: figures of the object, in SI, and never an array."""

import numpy as np
import pytest

import workbench as wb
from workbench.structure.domain import NamedPoints


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


def test_a_structure_says_its_ends_and_profiles(beam):
    text = str(beam).splitlines()
    assert text[0] == "beam, 2 m, left clamped, right free"
    assert text[2].split() == ["mass_per_length", "1.5", "1.5", "1.5"]


def test_nothing_prints_an_array(beam, rig, record):
    many = NamedPoints(tuple(f"p{i}" for i in range(1000)))
    for result in (beam, rig, record, rig.modes, many, record.only(["y"])):
        assert len(repr(result)) < 200 and "array(" not in repr(result) + str(result)
        assert len(str(result)) < 1000


def test_a_notebook_shows_the_same_table_with_nothing_left_to_run():
    record = wb.Record(0.1, np.zeros((1, 5)), (wb.Channel("<script>"),))
    shown = record._repr_html_()
    assert "<table>" in shown and "<script>" not in shown
