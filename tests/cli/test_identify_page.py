"""`workbench identify --page`: what a person looks at before believing modes; and the limits of time and memory."""

import json

import numpy as np
import pytest
from scipy.signal import lfilter

from workbench.records.files import read_record, write_record
from workbench.records.record import Channel, Record

RATE, N = 500.0, 2000
HERTZ, ZETA = np.array([12.0, 47.0]), 0.01


@pytest.fixture(scope="module")
def decay(tmp_path_factory):
    time, rng = np.arange(N) / RATE, np.random.default_rng(0)
    modes = np.exp(-ZETA * 2.0 * np.pi * np.outer(HERTZ, time)) * np.cos(2.0 * np.pi * np.outer(HERTZ, time))
    outputs = np.array([[1.0, 0.6], [0.5, -0.8]]) @ modes + 1e-3 * rng.standard_normal((2, N))
    path = tmp_path_factory.mktemp("decay") / "ring.csv"
    np.savetxt(path, np.column_stack([time, *outputs]), delimiter=",", header="time,a,b", comments="")
    return path


def test_the_page_shows_shapes_mac_stabilisation_and_spectra(run, decay, tmp_path):
    page = tmp_path / "modes.html"
    found = run("identify", decay, "--page", page)
    assert found.exit_code == 0, found.output
    content = json.loads(page.with_suffix(".page.json").read_text())
    captions = " ".join(block["caption"] for block in content["blocks"])
    for what in ("identified shapes", "Modal assurance criterion", "Stabilisation diagram", "spectral density"):
        assert what in captions
    [(_, _, rows)] = content["tables"]
    # rounded to the second digit of the standard error, as the terminal shows it
    for row, exact in zip(rows, HERTZ / np.sqrt(1.0 - ZETA**2), strict=True):  # HERTZ are damped
        value, error = float(row[1]), float(row[2])
        assert abs(value - exact) < 5.0 * error and len(row[2].lstrip("0.")) == 2


def test_the_page_says_how_it_was_made_in_the_words_of_the_command(run, decay, tmp_path, monkeypatch):
    page = tmp_path / "modes.html"
    options = ["--outputs", "a,b", "--seconds", "0.001", "--page", str(page)]
    monkeypatch.setattr("sys.argv", ["workbench", "identify", str(decay), *options])
    assert run("identify", decay, *options).exit_code == 0
    content = json.loads(page.with_suffix(".page.json").read_text())
    assert content["made_by"] == f"workbench identify {decay} {' '.join(options)}"
    assert any("allow more time by --seconds" in line for line in content["lines"])
    assert content["blocks"][0]["motion"]["label"] == "sensor"


def test_the_page_of_a_driven_record_shows_the_response_of_the_modes_beside_the_measured_one(run, tmp_path):
    """Truth: the z-transform of a mode under a held force that acts three samples late."""
    rng, pole = np.random.default_rng(0), (-0.02 + 1j) * 2.0 * np.pi * 30.0
    force, step = rng.standard_normal(6000), np.exp(pole / RATE)
    gain = (step - 1.0) / pole / (2j * pole.imag)
    late = np.r_[np.zeros(3), force[:-3]]
    motion = 2.0 * np.real(lfilter([0.0, gain], [1.0, -step], late.astype(complex)))
    sizes = np.linspace(1.0, 2.0, 7)
    outputs = sizes[:, None] * motion + 1e-3 * motion.std() * rng.standard_normal((7, 6000))
    channels = tuple(Channel(f"y{j + 1}", "displacement") for j in range(7))
    write_record(Record(1.0 / RATE, outputs, channels, force[None], (Channel("F", "force"),)), tmp_path / "driven.csv")
    page = tmp_path / "driven.html"
    found = run("identify", tmp_path / "driven.csv", "--page", page)
    assert found.exit_code == 0, found.output
    shown, coherence = json.loads(page.with_suffix(".page.json").read_text())["blocks"][-2:]
    assert shown["caption"].endswith("and of the identified modes (dashed). Not drawn: y7.")
    panels = shown["figure"]["panels"]
    assert len(panels) == 12 and len(coherence["figure"]["panels"][0]["marks"]) == 6
    for panel, size in zip(panels[::2], sizes[:6], strict=True):
        measured, model = panel["marks"]
        z = np.exp(2j * np.pi * np.array(model["x"]) / RATE)
        exact = size * np.abs(gain / (z - step) + np.conj(gain) / (z - np.conj(step)))
        seen = np.array(model["x"]) < 100.0  # beyond it is less than the noise
        assert model["dash"] and np.abs(np.array(model["y"]) / exact - 1.0)[seen].max() < 0.02
        assert min(measured["x"]) > 0 and max(model["x"]) < RATE / 2
    for panel in panels[1::2]:  # in phase too, where there is more than noise
        measured, model = panel["marks"]
        near = [k for k, hertz in enumerate(measured["x"]) if 10 < hertz < 60]
        turned = np.interp(np.array(measured["x"])[near], model["x"], np.unwrap(model["y"], period=360.0))
        apart = (np.array(measured["y"])[near] - turned + 180.0) % 360.0 - 180.0
        assert np.median(np.abs(apart)) < 3.0


@pytest.mark.parametrize("second", ["independent", "the same signal"])
def test_the_pages_of_a_record_of_two_inputs_show_the_responses_to_each_or_say_why_not(run, tmp_path, second):
    """Truth: the z-transform of a mode under the forces of two shakers."""
    rng, pole, sizes = np.random.default_rng(0), (-0.02 + 1j) * 2.0 * np.pi * 30.0, np.array([[1.0, -0.4]])
    forces = rng.standard_normal((2, 2000))
    if second == "the same signal":
        forces[1] = 2.0 * forces[0]
    step = np.exp(pole / RATE)
    gain = (step - 1.0) / pole / (2j * pole.imag)
    motion = 2.0 * np.real(lfilter([0.0, gain], [1.0, -step], (sizes @ forces)[0].astype(complex)))
    outputs = np.arange(1.0, 6.0)[:, None] * motion + 0.02 * motion.std() * rng.standard_normal((5, 2000))
    channels = tuple(Channel(f"y{j + 1}", "displacement") for j in range(5))
    inputs = tuple(Channel(name, "force") for name in ("F1", "F2"))
    write_record(Record(1.0 / RATE, outputs, channels, forces, inputs), tmp_path / "driven.csv")
    commands = [("look", ()), ("identify", ("--modes", 1, "--seconds", 1))]
    for command, options in commands[: 1 if second == "the same signal" else 2]:  # modes of such inputs are refused
        page = tmp_path / f"{command}.html"
        found = run(command, tmp_path / "driven.csv", *options, "--page", page)
        assert found.exit_code == 0, found.output
        blocks = json.loads(page.with_suffix(".page.json").read_text())["blocks"]
        caption = blocks[-1]["caption"]
        if second == "the same signal":
            why = "No frequency responses are shown: the inputs F1 and F2 are correlated, with a coherence of 1.000"
            assert caption.startswith("Power spectral density") and why in caption
            continue
        assert "Shown are 4 of 5 outputs, those of highest level first." in caption
        assert ("identified modes (dashed)" in caption) is (command == "identify")
        *panels, coherence = blocks[-1]["figure"]["panels"]
        assert [panel["y"]["label"][:3] for panel in panels] == ["|y5", "|y4", "|y3", "|y2"]
        for panel, size in zip(panels, (5.0, 4.0, 3.0, 2.0), strict=True):
            for mark, to_input in zip(panel["marks"], (*sizes[0], *sizes[0]), strict=False):
                hertz, drawn = np.array(mark["x"]), np.array(mark["y"])
                z = np.exp(2j * np.pi * hertz / RATE)
                exact = size * abs(to_input) * np.abs(gain / (z - step) + np.conj(gain) / (z - np.conj(step)))
                seen = (hertz > 10.0) & (hertz < 50.0)
                assert np.median(np.abs(drawn / exact - 1.0)[seen]) < 0.1
            assert len(panel["marks"]) == (4 if command == "identify" else 2)
        assert len(coherence["marks"]) == 4


@pytest.mark.slow
def test_the_page_of_frfs_shows_the_band_that_was_fitted(run, tmp_path):
    from scipy.io import savemat

    lines, page = np.linspace(0.0, 100.0, 2001), tmp_path / "p.html"
    omega, modes = 2.0 * np.pi * lines[:, None], 2.0 * np.pi * HERTZ
    response = 1.0 / (modes**2 - omega**2 + 2j * ZETA * modes * omega)
    savemat(tmp_path / "frf.mat", {"frf": response @ np.array([[1.0, 0.6], [0.5, -0.8]]), "frequency_hz": lines})
    found = run("identify", tmp_path / "frf.mat", "--band-hz", 5, 60, "--page", page)
    assert found.exit_code == 0, found.output
    panels = json.loads(page.with_suffix(".page.json").read_text())["blocks"][-1]["figure"]["panels"]
    assert len(panels[0]["marks"]) == 2  # measured and fitted
    assert panels and all(5 <= min(m["x"]) and max(m["x"]) <= 60 for p in panels for m in p["marks"])


@pytest.mark.parametrize("places", [[(0.2, 0.1), (0.5, 0.3)], ["P1", "P2"]], ids=["plate", "named points"])
def test_places_on_a_plate_and_names_of_points_are_written_and_reported(run, places, tmp_path):
    time, rng = np.arange(N) / RATE, np.random.default_rng(0)
    modes = np.exp(-ZETA * 2.0 * np.pi * np.outer(HERTZ, time)) * np.cos(2.0 * np.pi * np.outer(HERTZ, time))
    outputs = np.array([[1.0, 0.6], [0.5, -0.8]]) @ modes + 1e-3 * rng.standard_normal((2, N))
    channels = tuple(Channel(name, "displacement", at=at) for name, at in zip("ab", places))
    write_record(Record(1.0 / RATE, outputs, channels), tmp_path / "ring.csv")
    assert [channel.at for channel in read_record(tmp_path / "ring.csv").output_channels] == places
    found = run("identify", tmp_path / "ring.csv", "--json", tmp_path / "modes.json")
    assert found.exit_code == 0, found.output
    written = json.loads((tmp_path / "modes.json").read_text())["positions"]
    assert [tuple(at) if isinstance(at, list) else at for at in written] == places
    reported = run("report", tmp_path / "modes.json", "--page", tmp_path / "modes.html")
    assert reported.exit_code == 0, reported.output


def test_time_and_memory_are_limited(run, decay):
    refused = run("identify", decay, "--memory", 1e-5)
    assert refused.exit_code == 2 and "allow more memory" in " ".join(refused.output.split())
    assert run("look", decay, "--memory", 1e-5).exit_code == 2
    assert run("identify", decay, "--seconds", 0).exit_code == 2
    hurried = run("identify", decay, "--seconds", 1e-3)
    assert "--seconds" in hurried.output
