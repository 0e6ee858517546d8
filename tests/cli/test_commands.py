"""The command: what it finds on files a user has, its exit codes, and one clear line for bad input."""

import json
import re

import numpy as np
import pytest
from scipy.signal import lfilter, lsim
from typer.testing import CliRunner

from workbench.cli.app import app
from workbench.identification.signal.synthesis import free_decay, impulse_response_modes
from workbench.records.files import write_record
from workbench.records.record import Channel, Record
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam
from workbench.study.report import page_content_in

RIG = """
[structure]
kind = "beam"
length = 10.0
mass_per_length = 1.0
bending_stiffness = 1.0
left = "hinged"
right = "hinged"
damping_ratio = 0.0
modes = 9
[[input]]
name = "F1"
kind = "actuator"
at = 2.0
[[input]]
name = "F2"
kind = "actuator"
at = 4.0
[[input]]
name = "F3"
kind = "actuator"
at = 6.0
[[input]]
name = "F4"
kind = "actuator"
at = 8.0
[[input]]
name = "hammer"
kind = "hammer"
at = 6.3
[[output]]
name = "y"
quantity = "displacement"
at = 3.0
noise_std = 0.001
"""


@pytest.fixture
def rig(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    return path


def run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_identify_finds_the_modes_and_their_number(tmp_path):
    beam = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged",
                damping=ModalDamping(0.01))  # fmt: skip
    decay = impulse_response_modes(beam.modes(4), at=7.3, positions=[1.0, 3.0, 5.5, 8.0])
    record = free_decay(decay, sample_time=0.5, n_samples=1000, quantity="velocity", noise_std=0.003, seed=3)
    path, found = write_record(record, tmp_path / "ring.csv"), tmp_path / "found.json"
    result = run("identify", path, "--json", found)
    assert result.exit_code == 0, result.output
    assert "damping is not Rayleigh damping" in result.output  # it is modal, and as classical as that
    modes = json.loads(found.read_text())
    exact = (np.arange(1, 5) * np.pi / 10) ** 2 / (2 * np.pi)
    assert len(modes["frequencies_hz"]) == 4
    assert (np.abs(modes["frequencies_hz"] - exact) < 5 * np.array(modes["frequencies_std_hz"])).all()


def test_identify_says_which_modes_and_options_go_nowhere(tmp_path):
    beam = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged",
                damping=ModalDamping(0.01))  # fmt: skip
    decay = impulse_response_modes(beam.modes(2), at=7.3, positions=[1.0, 3.0])
    record = free_decay(decay, sample_time=1.0, n_samples=200, quantity="velocity", noise_std=0.003, seed=1)
    path = write_record(record, tmp_path / "ring.csv")
    many = run("identify", path, "--modes", 15)
    assert many.exit_code == 0 and "14 of the 15 modes asked for are found" in many.output, many.output
    assert "no further one is significant" not in many.output  # none was tested
    assert "cannot be modes; only without a number of modes is each tested for significance" in many.output.replace(
        "\n", " "
    )
    assert "asked for" not in run("identify", path, "--modes", 2).output
    held = run("identify", path, "--input-hold", "first")
    assert held.exit_code == 2 and "--input-hold is for records with inputs: name them by --inputs" in held.output


def test_identify_reads_records_with_inputs_and_ambient_ones(tmp_path):
    rng, dt, n = np.random.default_rng(2), 0.02, 6000
    pole = -0.3 + 9.0j
    force = rng.standard_normal(n)
    swing = (
        lfilter([0.0, (np.exp(pole * dt) - 1.0) / pole], [1.0, -np.exp(pole * dt)], force.astype(complex)).imag / 9.0
    )
    outputs = swing + 0.02 * swing.std() * rng.standard_normal(n)
    record = Record(dt, outputs[None], (Channel("tip"),), force[None], (Channel("shaker", "force"),))
    path, found = write_record(record, tmp_path / "driven.npz"), tmp_path / "found.json"
    result = run("identify", path, "--inputs", "shaker", "--json", found)
    assert result.exit_code == 0, result.output
    driven = json.loads(found.read_text())
    assert abs(driven["frequencies_hz"][0] * 2 * np.pi - abs(pole)) < 4 * driven["frequencies_std_hz"][0] * 2 * np.pi
    assert np.array(driven["state_space"]["A"]).shape == (2, 2) and driven["inputs"] == ["shaker"]
    assert run("identify", path, "--ambient").exit_code == 2
    alone = write_record(Record(dt, outputs[None], (Channel("tip"),)), tmp_path / "ambient.npz")
    result = run("identify", alone, "--ambient", "--modes", 1, "--json", found)
    assert result.exit_code == 0 and "canonical variate analysis" in result.output, result.output
    ambient = json.loads(found.read_text())
    assert abs(ambient["frequencies_hz"][0] * 2 * np.pi - abs(pole)) < 4 * ambient["frequencies_std_hz"][0] * 2 * np.pi


def test_identify_takes_inputs_that_run_straight(tmp_path):
    """Against the closed form of a response to straight lines, whose mode is real; held, it would be complex."""
    force, dt = np.random.default_rng(0).standard_normal(1500), 0.02
    _, moved, _ = lsim(([81.0], [1.0, 0.6, 81.0]), force, dt * np.arange(1500), interp=True)
    path, found = tmp_path / "measured.csv", tmp_path / "found.json"
    table = np.column_stack(
        [dt * np.arange(1500), force, moved + 1e-4 * np.random.default_rng(1).standard_normal(1500)]
    )
    np.savetxt(path, table, delimiter=",", header="time,F,a", comments="")
    real_parts = []
    for options in ((), ("--input-hold", "first")):
        assert run("identify", path, "--inputs", "F", *options, "--json", found).exit_code == 0
        [[real], [imaginary]] = json.loads(found.read_text())["state_space"]["B"]
        real_parts.append(abs(real))
    assert imaginary == pytest.approx(-81.0 / (2.0 * np.sqrt(81.0 - 0.3**2)), rel=1e-4)  # the residue, k / 2i ω_d
    assert real_parts[1] < 1e-3 < 0.3 < real_parts[0]
    refused = run("identify", path, "--inputs", "F", "--input-hold", "second")
    assert refused.exit_code == 2 and "--input-hold is zero (held), first" in " ".join(refused.output.split())


def test_identify_reads_frfs(tmp_path):
    lines, omega, zeta = np.linspace(1.0, 30.0, 400), 2.0 * np.pi * np.array([8.0, 19.0]), 0.01
    s = 2j * np.pi * lines
    shapes = np.array([[1.0, 0.6], [0.5, -1.0], [-0.2, 0.3]])
    h = shapes @ (s**2 / (s**2 + 2.0 * zeta * np.outer(omega, s) + omega[:, None] ** 2))
    noise = np.random.default_rng(0).standard_normal((2, *h.shape))
    path, found = tmp_path / "frf.npz", tmp_path / "found.json"
    np.savez(path, frequency_hz=lines, H=h + 0.02 * (noise[0] + 1j * noise[1]))
    result = run("identify", path, "--json", found)
    assert result.exit_code == 0 and "FRFs of 3 outputs and 1 input, 400 lines" in result.output
    modes = json.loads(found.read_text())
    scores = (np.array(modes["frequencies_hz"]) - [8.0, 19.0]) / modes["frequencies_std_hz"]
    assert np.abs(scores).max() < 4.0 and modes["sensors"] == ["H 1", "H 2", "H 3"]
    assert modes["order_limited_hz"] == [] and not any(modes["doubtful"]) and "reached its limit" not in result.output
    one = run("identify", path, "--outputs", "H 2", "--band-hz", 5, 12, "--json", found)
    assert one.exit_code == 0 and len(json.loads(found.read_text())["frequencies_hz"]) == 1
    few = run("identify", path, "--modes", 1)
    assert few.exit_code == 0 and "the search reached its limit on the number of modes" in " ".join(few.output.split())
    for options, said in (
        (("--start", 1.0), "leave --start and --ambient out"),
        (("--inputs", "a"), "name no inputs"),
        (("--outputs", "x"), "has no output 'x'"),
    ):
        refused = run("identify", path, *options)
        assert refused.exit_code == 2 and said in " ".join(refused.output.split())


def test_designs_and_placements_are_told_in_the_units_of_the_file(rig, tmp_path):
    rig.write_text(rig.read_text() + '[units]\nlength = "mm"\nmass = "t"\ntime = "s"\nforce = "N"\n')
    laws = run("design", rig, "--controlled-modes", 4, "--weight", 20).output
    assert "W_C [N mm]  W_R [N mm]" in laws and "R weights FᵀF" in laws
    placed = run("place", rig, "--controlled-modes", 2, "--figure", tmp_path / "places.png")
    assert "positions [mm]" in placed.output and "W_R [N mm]" in placed.output and (tmp_path / "places.png").is_file()


def test_decay_rates_are_told_in_the_unit_of_time_of_the_file(rig, tmp_path):
    rig.write_text(rig.read_text() + '[units]\nlength = "mm"\nmass = "kg"\ntime = "ms"\nforce = "kN"\n')
    found = tmp_path / "design.json"
    laws = run("design", rig, "--controlled-modes", 4, "--weight", 20, "--json", found).output
    assert "decay rate, -max Re λ [1/ms]" in laws and "1/s" not in laws
    (limit,) = {one["limited_by"].split()[-1] for one in json.loads(found.read_text())["through_sensors"]}
    assert limit == "1/ms"
    (sensed,) = [heads for title, heads, _ in page_content_in(found).tables if title == "With sensors"]
    assert sensed[1] == "decay rate, -max Re λ [1/ms]"


def test_design_reports_the_works_of_section_5_8(rig, tmp_path):
    found = tmp_path / "design.json"
    result = run("design", rig, "--controlled-modes", 4, "--weight", 20, "--final-time", 3000, "--json", found)
    assert result.exit_code == 0, result.output
    written = json.loads(found.read_text())
    imsc, coupled = written["laws"]
    assert written["controlled"] == [1, 2, 3, 4]  # as a page and the command count modes
    expected = [1.213865e-3, 5.203347e-5, 1.294254e-4, 1.037589e-4]
    np.testing.assert_allclose(imsc["work"][5:], expected, rtol=1e-5)
    assert coupled["cost"] <= imsc["cost"] * (1 + 1e-9)
    assert "mode 6" in result.output and "residual modes that start at rest and have their damping" in result.output
    assert "decay rate, -max Re λ [1/s]" in result.output and "y → F2" in result.output
    page = run("report", found, "--page", tmp_path / "p.html")
    assert page.exit_code == 0 and "page" in page.output
    assert "coupled LQR" in (tmp_path / "p.html").read_text() and (tmp_path / "p.page.json").is_file()


def test_design_has_observers_of_rigid_modes_and_says_what_is_on_the_axis(tmp_path):
    free = tmp_path / "free.toml"
    second = '[[output]]\nname = "z"\nquantity = "displacement"\nat = 7.5\n'  # two rigid modes take two sensors
    free.write_text(RIG.replace('"hinged"', '"free"') + second)
    result = run("design", free, "--controlled-modes", 2)
    assert result.exit_code == 0 and "IMSC on a Luenberger observer" in result.output, result.output
    # two undamped laws, through exact modal coordinates: whatever rounding makes of poles on the axis
    assert [line.split()[-2:] for line in result.output.splitlines()[2:4]] == [["marginally", "stable"]] * 2
    by_ratio = run("design", free, "--controlled-modes", 2, "--damping", 0.2)
    assert by_ratio.exit_code == 0 and "the rigid mode(s) 1, 2 have no damping ratio" in by_ratio.output, (
        by_ratio.output
    )
    free.write_text(free.read_text().replace("modes = 9", "modes = 2"))
    assert "without elastic modes the final time" in run("design", free, "--controlled-modes", 2).output


def test_design_offers_what_can_be_had(rig, tmp_path):
    found = tmp_path / "design.json"
    nodes = run("design", rig, "--controlled-modes", 5)
    assert nodes.exit_code == 2 and "mode 5 is uncontrollable: all actuators are at its nodes" in nodes.output
    rig.write_text(rig.read_text().replace("at = 4.0", "at = 4.3"))
    few = run("design", rig, "--controlled-modes", 5, "--damping", 0.1, "--errors", 0.02, "--json", found)
    assert "stable of 100 models with 2 % error" in few.output
    assert few.exit_code == 0 and "IMSC needs as many actuators as controlled modes, 5; there are 4" in few.output
    told = json.loads(found.read_text())
    assert [law["law"] for law in told["laws"]] == ["coupled LQR", "coupled poles"]
    poles = np.array(told["laws"][1]["poles_real"]) + 1j * np.array(told["laws"][1]["poles_imag"])
    assert ((np.abs(-poles.real / np.abs(poles) - 0.1) < 1e-6) & (poles.imag > 0)).sum() == 5
    assert all(0 <= design["robustness"] <= 1 for design in told["through_sensors"])


def test_place_does_better_than_even_places(rig, tmp_path):
    found = tmp_path / "places.json"
    result = run("place", rig, "--controlled-modes", 4, "--weight", 20, "--json", found)
    assert result.exit_code == 0, result.output
    best, even, nodes = json.loads(found.read_text())["placements"]
    assert best["residual_work"] < min(even["residual_work"], nodes["residual_work"])
    assert best["effort"] <= 1.5 * even["effort"] * (1 + 1e-6)
    _, heads, first, second, *told = result.output.splitlines()
    assert heads.startswith("placement ") and first.startswith("best found ")
    assert second.startswith("evenly spaced, nodes of mode 5 ")  # which are the same places, in one row
    assert "residual modes, which start at rest, without damping and over all time" in told[0]
    assert told[1].strip() == "search: converged"


def test_patches_on_a_beam_are_placed_beside_each_other(tmp_path):
    inputs = "".join(
        f'[[input]]\nname = "P{i}"\nkind = "actuator"\nquantity = "moment"\nat = {at}\npatch = 0.4\n'
        for i, at in enumerate((0.3, 0.8))
    )
    path, found = tmp_path / "beam.toml", tmp_path / "places.json"
    path.write_text(
        '[structure]\nkind = "beam"\nlength = 1.2\nmass_per_length = 0.62\nbending_stiffness = 14.0\nleft = "clamped"\n'
        f'right = "free"\nmodes = 6\ndamping_ratio = 0.004\n{inputs}[[input]]\nname = "hammer"\nkind = "hammer"\n'
        'at = 0.9\n[[output]]\nname = "y"\nquantity = "displacement"\nat = 0.4\nnoise_std = 1e-6\n'
    )
    result = run("place", path, "--controlled-modes", 2, "--effort-ratio", 3, "--json", found)
    assert result.exit_code == 0, result.output
    first, second = json.loads(found.read_text())["placements"][0]["positions"]
    assert second - first >= 0.4 - 1e-6 and "overlap" not in result.output


@pytest.mark.slow
def test_a_placement_is_proven_under_every_limit(rig, tmp_path):
    found = tmp_path / "places.json"
    limits = ("--peak-force", 0.5, "--condition", 3, "--forbid", "4.9:5.6", "--certify", 0.05)
    result = run("place", rig, "--controlled-modes", 2, "--weight", 20, *limits, "--json", found)
    assert result.exit_code == 0, result.output
    written = json.loads(found.read_text())
    bound = f"W_R below {written['lower_bound']:.4g} J, 5 % under that of the one found"
    assert f"certified: no placement within the limits has {bound}" in result.output
    assert written["certified"] and written["limits"]["forbidden"] == [[4.9, 5.6]]
    best = written["placements"][0]
    assert written["lower_bound"] == pytest.approx(0.95 * best["residual_work"])
    assert best["peak_force"] <= 0.5 * (1 + 1e-5) and not any(4.9 < x < 5.6 for x in best["positions"])


def test_places_are_chosen_from_those_there_are(rig, tmp_path):
    found = tmp_path / "places.json"
    given = ("--at", "1.5,3,4.5,6.5,7,8.5", "--effort-ratio", 3, "--certify", 0.05)
    result = run("place", rig, "--controlled-modes", 3, "--weight", 20, *given, "--json", found)
    assert result.exit_code == 0, result.output
    assert re.search(r"certified: .* W_R below \S+ J, that of the one found", result.output)
    assert set(json.loads(found.read_text())["placements"][0]["positions"]) <= {1.5, 3, 4.5, 6.5, 7, 8.5}


PLATE = """[structure]
kind = "plate"
length = [1.2, 0.8]
mass_per_area = 8.0
bending_stiffness = 175.0
poisson_ratio = 0.3
edges = {left = "simply supported", right = "simply supported", bottom = "simply supported", top = "simply supported"}
damping_ratio = 0.005
modes = 8
[[input]]
name = "F1"
kind = "actuator"
at = [0.3, 0.24]
[[input]]
name = "F2"
kind = "actuator"
at = [0.84, 0.52]
[[input]]
name = "hammer"
kind = "hammer"
at = [0.5, 0.46]
[[output]]
name = "w1"
quantity = "displacement"
at = [0.36, 0.56]
noise_std = 1e-6
[[output]]
name = "w2"
quantity = "displacement"
at = [0.7, 0.2]
noise_std = 1e-6
"""


def test_an_input_at_a_node_is_placed_at_its_point_in_its_direction(tmp_path):
    rows = [f"{n}{d},{n},0,0,{n},{d},{0.2 * n + 0.1 * (d == 'y')},{0.3 - 0.1 * n}" for n in (1, 2) for d in "xy"]
    (tmp_path / "points.csv").write_text("\n".join(["name,node,x,y,z,direction,mode_1,mode_2", *rows]))
    inputs = "".join(
        f'[[input]]\nname = "{kind}"\nkind = "{kind}"\npoint = "2"\ndirection = "y"\n'
        for kind in ("actuator", "hammer")
    )
    (tmp_path / "case.toml").write_text(
        '[structure]\nkind = "modal"\nnatural_frequencies_hz = [1.0, 3.0]\ndamping_ratios = [0.01, 0.01]\n'
        f'points = "points.csv"\n{inputs}[[output]]\nname = "y"\nquantity = "displacement"\npoint = "2y"\n'
        "noise_std = 1.0\n"
    )
    result = run("place", tmp_path, "--controlled-modes", 1)
    assert result.exit_code == 0 and "unit impulse at 2y" in result.output, result.output
    assert run("design", tmp_path, "--controlled-modes", 1).exit_code == 0


@pytest.fixture
def plate(tmp_path):
    path = tmp_path / "plate.toml"
    path.write_text(PLATE)
    return path


def test_a_plate_is_placed_outside_a_zone_and_drawn(plate, tmp_path):
    found, picture = tmp_path / "places.json", tmp_path / "places.png"
    zone = ("--forbid", "0.3,0.2:0.6,0.5")
    result = run("place", plate, "--controlled-modes", 2, "--weight", 0.01, *zone, "--figure", picture, "--json", found)
    assert result.exit_code == 0, result.output
    assert "unit impulse at (x, y) = (0.5, 0.46)" in result.output and "positions [m]" in result.output
    best, own = json.loads(found.read_text())["placements"]
    assert own["positions"] == [[0.3, 0.24], [0.84, 0.52]]
    assert best["residual_work"] < own["residual_work"] and best["effort"] <= 1.5 * own["effort"] * (1 + 1e-6)
    assert not any(0.3 < x < 0.6 and 0.2 < y < 0.5 for x, y in best["positions"])
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_candidates_of_a_plate_are_proven(plate, tmp_path):
    found = tmp_path / "places.json"
    given = ("--at", "0.3,0.24; 0.4,0.4; 0.8,0.4; 0.84,0.52; 1.0,0.4", "--effort-ratio", 3, "--certify", 0.05)
    result = run("place", plate, "--controlled-modes", 2, "--weight", 0.01, *given, "--json", found)
    assert result.exit_code == 0, result.output
    # modes (1, 1) and (2, 1) from a third and two thirds of the length on the midline: nothing reaches (1, 2) or (3, 1)
    assert json.loads(found.read_text())["placements"][0]["positions"] == [[0.4, 0.4], [0.8, 0.4]]


def test_a_grid_over_a_plate_is_proven(plate, tmp_path):
    """Nodes of a grid that keep out of the zone; its best choice is within the proof of all of them."""
    found = tmp_path / "places.json"
    given = (
        "--controlled-modes",
        2,
        "--weight",
        0.01,
        "--forbid",
        "0.3,0.2:0.6,0.5",
        "--effort-ratio",
        3,
        "--certify",
        0.05,
    )
    result = run("place", plate, *given, "--grid", 0.1, "--json", found)
    assert result.exit_code == 0, result.output
    best, written = json.loads(found.read_text())["placements"][0], json.loads(found.read_text())
    for x, y in best["positions"]:
        assert x == pytest.approx(round(10 * x) / 10) and y == pytest.approx(round(10 * y) / 10)
        assert not (0.3 < x < 0.6 and 0.2 < y < 0.5)
    assert written["lower_bound"] >= 0.95 * best["residual_work"]
    for more, words in (
        (("--grid", 0.9), "--grid must be between 0 and half the shorter side, 0.4 m; got 0.9"),
        (("--grid", 0.1, "--at", "0.3,0.2"), "--grid and --at both name candidate places; leave one of them out"),
        ((), "--certify on a plate needs candidate places; give their spacing by --grid M, or --at PLACES"),
    ):
        refused = run("place", plate, *given, *more)
        assert refused.exit_code == 2 and words in refused.output


def test_laws_on_a_plate_are_compared_through_a_filter_and_an_observer(plate, tmp_path):
    found = tmp_path / "laws.json"
    result = run("design", plate, "--controlled-modes", 2, "--weight", 0.01, "--json", found)
    assert result.exit_code == 0, result.output
    through = json.loads(found.read_text())["through_sensors"]
    ways = ("through a modal filter", "on a Luenberger observer")
    assert [row["design"] for row in through] == [f"{law} {way}" for law in ("IMSC", "coupled LQR") for way in ways]
    assert all(row["decay_rate"] == pytest.approx(-max(row["poles_real"])) for row in through)


def test_patches_on_a_plate_are_placed_and_designed(plate, tmp_path):
    text = plate.read_text()
    for at in ("[0.3, 0.24]", "[0.84, 0.52]"):
        text = text.replace(f"at = {at}", f"at = {at}\npatch = [0.2, 0.15]")
    plate.write_text(text)
    found = tmp_path / "places.json"
    result = run("place", plate, "--controlled-modes", 2, "--weight", 10, "--json", found)
    assert result.exit_code == 0, result.output
    assert "effort [(N m/m)² s]  peak moment [N m/m]" in result.output  # a line moment along the edges
    best, own = json.loads(found.read_text())["placements"]
    assert own["positions"] == [[0.3, 0.24], [0.84, 0.52]] and best["residual_work"] < own["residual_work"]
    assert all(0.1 <= x <= 1.1 and 0.075 <= y <= 0.725 for x, y in best["positions"])
    result = run("design", plate, "--controlled-modes", 2, "--weight", 10)
    assert result.exit_code == 0 and "effort [(N m/m)² s]  peak moment [N m/m]" in result.output, result.output
    plate.write_text(text.replace("patch = [0.2, 0.15]", "patch = [0.2, 0.1]", 1))
    result = run("place", plate, "--controlled-modes", 2)
    assert result.exit_code == 2 and "F2 is not a patch like F1" in " ".join(result.output.split())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--impulse-at", "3,0.1"), "--impulse-at: (x, y) = (3, 0.1) lies outside the structure, 0 to 1.2 by 0 to 0.8"),
        (("--impulse-at", "0.4"), "--impulse-at takes X,Y in m, such as 0.4,0.25; got '0.4'"),
        (("--forbid", "0.2:0.3"), "--forbid takes X,Y in m, such as 0.4,0.25; got '0.2'"),
        (("--at", "0.2,0.3"), "2 actuators need as many places; the limits allow 1"),
        (("--controlled-modes", 3), "there are 2 for 3 modes: describe 3 [[input]] of kind actuator"),
    ],
)
def test_places_that_a_plate_does_not_have_are_refused(plate, arguments, words):
    result = run("place", plate, "--controlled-modes", 2, *arguments)
    assert result.exit_code == 2, result.output
    assert words in " ".join(result.output.split())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("identify", "nowhere.csv"), "no such file"),
        (("identify", "\x1b[31mred\n.csv"), "\\x1b[31mred .csv: there is no such file"),
        (("identify", "{rig}"), "names no format"),
        (("design", "nowhere.toml"), "no such file"),
        (("design", "{rig}", "--damping", 1), "--damping must lie between 0 and 1"),
        (("design", "{rig}", "--errors", 0), "--errors is a share between 0 and 1, 0.05 for 5 %; got 0"),
        (("design", "{rig}", "--errors", 5), "a share between 0 and 1, 0.05 for 5 %; got 5"),
        (("design", "{rig}", "--weight", -1), "--weight must be positive; got -1"),
        (("place", "{rig}", "--controlled-modes", 4, "--weight", -1), "--weight must be positive; got -1"),
        (("place", "{rig}", "--controlled-modes", 4, "--figure", "a.xyz"), "--figure writes .png, .svg, .pdf"),
        (("trial", "{rig}", "--figure", "a"), "name a file such as a.png; got a"),
        (("look", "nowhere.csv", "--page", "p.pdf"), "--page writes HTML; name a file such as p.html; got p.pdf"),
        (("report", "nowhere.json", "--page", "p"), "--page writes HTML; name a file such as p.html; got p"),
        (("design", "{rig}", "--controlled-modes", -1), "controlled modes is 1 to 9, those of the model; got -1"),
        (("design", "{rig}", "--final-time", -1), "final time must be positive and finite; got -1"),
        (("design", "{rig}", "--final-time", 0), "final time must be positive and finite; got 0"),
        (("design", "{rig}", "--json", "nowhere/found.json"), "there is no folder nowhere"),
        (("place", "{rig}", "--controlled-modes", 4, "--json", "nowhere/found.json"), "there is no folder nowhere"),
        (
            ("place", "{rig}", "--controlled-modes", 4, "--forbid", "0.5:10"),
            "only 2 find room on the allowed intervals, 0 to 0.5 m:",
        ),
        (("place", "{rig}", "--controlled-modes", 9), "residual"),
        (
            ("place", "{rig}", "--controlled-modes", 4, "--grid", 0.1),
            "--grid is for a plate; name candidate places by --at",
        ),
        (
            ("place", "{rig}", "--controlled-modes", 1, "--effort-ratio", 0.01),
            "raise --effort-ratio or lower --spacing; --effort-ratio is a",
        ),
        (
            ("place", "{rig}", "--controlled-modes", 1, "--effort-ratio", -1),
            "--effort-ratio is a multiple, above 0, of the effort at even",
        ),
        (
            ("place", "{rig}", "--controlled-modes", 2, "--peak-force", 0.01),
            "meets the limits: --peak-force is 0.01 N with a",
        ),
        (("place", "{rig}", "--controlled-modes", 2, "--peak-force", -1), "--peak-force must be positive; got -1"),
        (("place", "{rig}", "--controlled-modes", 2, "--spacing", -1), "--spacing must be 0 or more; got -1"),
        (("place", "{rig}", "--controlled-modes", 4, "--impulse-at", 11), "outside the structure"),
        (("place", "{rig}", "--controlled-modes", 4, "--at", "1,2,3,11"), "outside the structure"),
        (("place", "{rig}", "--controlled-modes", 4, "--at", "1 to 9"), "separated by commas"),
        (("diagnose", "nowhere"), "not a folder"),
        (("study", "nothing_of_that_name"), "no study is called"),
        (("report", "nowhere.json"), "no such file"),
        (("bench", "nowhere.toml"), "no such file"),
        (("bench", "{rig}", "--port", 1_000_000), "port 1000000 is not available"),
        (("report", "{rig}"), "no study is called"),
        (("study", "ruler"), "needs --data"),
        (("study", "ruler", "--data", "nowhere.mat"), "no such file"),
    ],
)
def test_bad_input_ends_in_one_line_and_code_2(rig, arguments, words):
    result = run(*(str(a).format(rig=rig) for a in arguments))
    assert result.exit_code == 2, result.output
    assert words in result.output and "Traceback" not in result.output
    assert len(result.output.strip().splitlines()) <= 2


@pytest.mark.parametrize("command", ["design", "place"])
def test_damping_in_per_cent_is_no_design(rig, tmp_path, command):
    """Of modes that are damped critically nothing is left to control."""
    text = rig.read_text()
    (written,) = {line for line in text.splitlines() if line.startswith("damping_ratio")}
    (tmp_path / "percent.toml").write_text(text.replace(written, "damping_ratio = 3"))
    refused = run(command, tmp_path / "percent.toml", "--controlled-modes", 4)
    assert refused.exit_code == 2
    assert "a share of critical damping, below 1, such as 0.02 for 2 %; got 3" in refused.output


def test_a_study_that_does_not_hold_ends_in_code_1(tmp_path, monkeypatch):
    (tmp_path / "studies").mkdir()
    (tmp_path / "studies" / "wrong.py").write_text(
        '"""Is two less than [one]?"""\n\ndef study(outcome, data=None):\n    outcome.check("two", 2.0, 1.0)\n'
    )
    monkeypatch.chdir(tmp_path)
    assert "Is two less than [one]?" in run("study").output
    result = run("study", "wrong")
    assert result.exit_code == 1 and "does not hold: two: 2.0 against 1.0" in result.output
    assert json.loads((tmp_path / "studies/results/wrong.json").read_text())["checks"][0]["holds"] is False
    assert (tmp_path / "out/wrong.html").is_file()


def test_an_unfinished_study_keeps_no_other_from_running(tmp_path, monkeypatch):
    (tmp_path / "studies").mkdir()
    (tmp_path / "studies/begun.py").write_text("def study(outcome,")
    (tmp_path / "studies/falls.py").write_text('"""Does it?"""\n\ndef study(outcome, data=None):\n    raise OSError\n')
    (tmp_path / "studies/whole.py").write_text(
        '"""Is one one?"""\n\ndef study(outcome, data=None):\n    outcome.check("one", 1.0, 1.0)\n'
    )
    monkeypatch.chdir(tmp_path)
    listed = run("study")
    lines = [" ".join(line.split()) for line in listed.output.replace(str(tmp_path) + "/", "").splitlines()]
    assert listed.exit_code == 0 and "whole Is one one?" in lines
    assert any(line.startswith("begun cannot be run: studies") for line in lines)
    assert run("study", "whole").exit_code == 0
    named = run("study", "begun")
    assert named.exit_code == 2 and "begun.py is not a study" in named.output
    every = run("study", "--all")
    assert every.exit_code == 1 and "1 of 1 checks hold" in every.output
    assert "begun.py is not a study" in every.output and "falls: OSError" in every.output


def test_studies_share_what_lies_beside_them(tmp_path, monkeypatch):
    (tmp_path / "studies").mkdir()
    (tmp_path / "studies/shared_by_mine.py").write_text("LENGTH = 0.6\n")
    (tmp_path / "studies/uses.py").write_text(
        '"""Does it?"""\nimport shared_by_mine\n\ndef study(outcome, data=None):\n'
        '    outcome.check("length", shared_by_mine.LENGTH, 1.0)\n'
    )
    monkeypatch.chdir(tmp_path)
    every = run("study", "--all")
    assert every.exit_code == 0 and "1 of 1 checks hold" in every.output
    assert run("study", "shared_by_mine").exit_code == 2
    for given in (("uses",), ("--data", ".")):
        refused = run("study", "--all", *given)
        assert refused.exit_code == 2 and "--all runs every study that makes its own data" in refused.output


def test_words_of_several_lines_are_told_in_one(tmp_path, monkeypatch):
    (tmp_path / "studies").mkdir()
    (tmp_path / "studies/torn.py").write_text(
        '"""Why?"""\ndef study(outcome, data=None):\n    raise ValueError("a\\n  matrix\\n[[1]]")\n'
    )
    monkeypatch.chdir(tmp_path)
    result = run("study", "torn")
    assert result.exit_code == 2 and result.output.splitlines()[-1].startswith("workbench: a matrix [[1]] (")
    assert result.output.splitlines()[-1].endswith("torn.py, line 3)")


MANY = """'Is a third of two an error?'

def third(at):
    if at == 2:
        raise ArithmeticError("two")
    return {"third": at / 3}

def study(outcome, data=None):
    found = outcome.run([{"at": 1}, {"at": 2}], third, workers=1)
    outcome.run([{"at": 1}], third, workers=1)
    outcome.check("third", found[0]["third"], 0.5)
"""


def test_cases_that_fail_are_reported_at_the_end_beside_the_others(tmp_path, monkeypatch):
    (tmp_path / "studies").mkdir()
    (tmp_path / "studies/many.py").write_text(MANY)
    monkeypatch.chdir(tmp_path)
    result = run("study", "studies/many.py")
    assert result.exit_code == 1 and "1 of 2 cases failed" in result.output
    assert "{'at': 2}: ArithmeticError: two" in result.output and "1 of 1 checks hold" in result.output
    assert len((tmp_path / "out/many-cases-2.csv").read_text().splitlines()) == 2
    rows = (tmp_path / "out/many-cases.csv").read_text().splitlines()
    assert rows[0].startswith("at,third,seed,error,seconds") and rows[1].startswith("1,0.3333333333333333,,,")
    [kept] = (tmp_path / "out/cache").rglob("*.json")
    monkeypatch.setattr("workbench.study.runs.engines.CONNECT_SECONDS", 0.5)
    away = run("study", "many", "--scheduler", "tcp://127.0.0.1:1")
    assert away.exit_code == 2 and "no Dask scheduler answers" in away.output and kept.is_file()


def test_every_command_explains_itself_with_an_example():
    for name in (
        "study",
        "identify",
        "design",
        "place",
        "diagnose",
        "redesign",
        "trial",
        "report",
        "bench",
        "look",
        "new",
    ):
        result = run(name, "--help")
        assert result.exit_code == 0 and "Example: workbench" in result.output


def test_help_shows_what_stands_in_brackets_and_how_many_values_an_option_takes():
    shown = " ".join(run("design", "--help").output.replace("│", " ").split())
    assert "[structure], [[input]] and [[output]]" in shown
    assert "LOW HIGH" in run("identify", "--help").output


def test_identify_cuts_a_record_to_its_decay_and_says_what_it_did(tmp_path):
    beam = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged",
                damping=ModalDamping(0.01))  # fmt: skip
    decay = impulse_response_modes(beam.modes(2), at=7.3, positions=[1.0, 3.0])
    record = free_decay(decay, sample_time=0.5, n_samples=1000, quantity="velocity", noise_std=0.003, seed=3)
    quiet = 0.003 * np.random.default_rng(0).standard_normal((2, 400))
    columns = np.vstack([0.5 * np.arange(1400), np.hstack([quiet, record.outputs]), np.arange(1400)]).T
    path, found = tmp_path / "ring.txt", tmp_path / "found.json"
    np.savetxt(path, columns, header="t y1 y2 count")
    refused = run("identify", path)
    assert refused.exit_code == 2 and "'count' is a straight line, a clock or a counter" in refused.output
    result = run("identify", path, "--outputs", "y1,y2", "--json", found)
    assert result.exit_code == 0 and "free decay from 200 s on" in result.output, result.output
    told = json.loads(found.read_text())
    assert told["start"] == [200.0] and len(told["frequencies_hz"]) == len(told["remarks"]) == 2
    later = run("identify", path, "--outputs", "y1,y2", "--start", 250, "--modes", 2)
    assert later.exit_code == 0 and "900 samples at 2 Hz from 250 s on" in later.output
