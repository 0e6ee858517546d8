"""Plates and frames of blind trials against closed forms and published values, and trials made on them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from workbench.cases.case import Case
from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect, apply_all, place_values
from workbench.rig.actuators import Actuator, piezo_patch
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import Between, NamedPoints, Patch, Rectangle
from workbench.structure.member import Beam
from workbench.structure.plate import Plate
from workbench.trials.benches import draw_bench, experiments
from workbench.trials.draws import NominalMotion
from workbench.trials.finite_elements import Alterations, element_modes, matrix_modes
from workbench.trials.hidden import place_of
from workbench.trials.hold import NOT_ON, draw_kinds, hold_trials
from workbench.trials.make import KINDS, make_trial
from workbench.trials.plane_frame import Section, plane_frame
from workbench.trials.plate_elements import plate_modes
from workbench.trials.scoring import score

CHANNELS = ("kind", "input", "output", "with", "from", "at", "between")

ATTACHED = {"point_mass", "ground_spring"}
LOCKING = {"two_way_friction"}


def _plate(edges, **changes) -> Plate:
    facts = {"length": (1.0, 1.0), "mass_per_area": 2.0, "bending_stiffness": 3.0, "poisson_ratio": 0.3}
    return Plate(**{**facts, **changes}, edges=edges)


# --- a plate of Bogner-Fox-Schmit elements


def test_simply_supported_plate_has_products_of_sines():
    a, b, m, stiffness = 1.2, 0.8, 2.0, 3.0
    found = plate_modes(_plate("simply supported", length=(a, b)), [(0.3, 0.2), Patch(0.4, 0.3, 0.2, 0.1)], 6)
    i, j = np.meshgrid(np.arange(1, 6), np.arange(1, 6))
    kx, ky = np.pi / a * i.ravel(), np.pi / b * j.ravel()
    order = np.argsort(kx**2 + ky**2)[:6]
    kx, ky = kx[order], ky[order]
    np.testing.assert_allclose(found.omega, np.sqrt(stiffness / m) * (kx**2 + ky**2), rtol=2e-6)
    size = 2.0 / np.sqrt(m * a * b)
    np.testing.assert_allclose(np.abs(found.shapes[0]), size * np.abs(np.sin(0.3 * kx) * np.sin(0.2 * ky)), atol=1e-5)
    # ∮ ∂φ/∂n ds = ∫∫ ∇²φ dA of the patch
    over_x, over_y = (
        (np.cos(k * (middle - half)) - np.cos(k * (middle + half))) / k
        for k, middle, half in ((kx, 0.4, 0.1), (ky, 0.3, 0.05))
    )
    expected = size * (kx**2 + ky**2) * np.abs(over_x * over_y)
    np.testing.assert_allclose(np.abs(found.shapes[1]), expected, atol=1e-4 * expected.max())


@pytest.mark.parametrize(
    ("edges", "first", "values"),
    [
        pytest.param("clamped", 0, [35.985, 73.394, 73.394, 108.22, 131.58, 132.21], marks=pytest.mark.slow),
        ({"left": "clamped", "right": "free", "bottom": "free", "top": "free"}, 0, [3.471, 8.507, 21.28, 27.20, 30.96]),
        pytest.param("free", 3, [13.468, 19.596, 24.270, 34.801, 34.801], marks=pytest.mark.slow),
    ],
    ids=["clamped", "cantilever", "free"],
)
def test_square_plates_have_their_published_frequencies(edges, first, values):
    """Leissa, J. Sound Vib. 31 (1973) 257: λ² = ω a² √(m/D)."""
    found = plate_modes(_plate(edges), [], first + len(values)).omega[first:] * np.sqrt(2.0 / 3.0)
    np.testing.assert_allclose(found, values, rtol=3e-4)


def test_a_spring_on_a_plate_solves_the_secular_equation():
    """1 + k Σ φ_r² / (ω_r² - ω²) = 0 over the sines of the plate alone."""
    at, k, square = (0.31, 0.42), 400.0, Plate.modes(_plate("simply supported", length=(1.2, 0.8)), 4000)
    shape = square.phi(at)[0]

    def secular(omega):
        return 1.0 + k * np.sum(shape**2 / (square.omega**2 - omega**2))

    first, second = square.omega[:2]
    root = brentq(secular, first * (1 + 1e-9), second * (1 - 1e-9))
    assert root > 1.05 * first, "the spring must matter"
    found = plate_modes(_plate("simply supported", length=(1.2, 0.8)), [], 1, altered=Alterations(springs=((at, k),)))
    assert found.omega[0] == pytest.approx(root, rel=1e-4)  # what the series leaves out


def test_a_plate_whose_mass_varies_moves_a_mode_by_its_share_of_it():
    """δω²/ω² = -∫ c cos(4π x / a) sin²(2π x / a) / ∫ sin² = c / 2 for mode (2, 1), and 0 for (1, 1), to first order."""
    plate, c = _plate("simply supported", length=(1.2, 0.8)), 1e-3
    altered = Alterations(mass_waves=(0.0, 0.0, 0.0, c))
    one, other = (plate_modes(plate, [], 2, altered=each).omega for each in (Alterations(), altered))
    np.testing.assert_allclose((other / one) ** 2 - 1.0, [0.0, 0.5 * c], atol=2e-3 * c)


# --- a frame of beam elements


def test_a_strip_that_varies_along_its_height_is_the_beam_that_does():
    variation = {"stiffness_waves": (0.02, -0.03), "mass_waves": (-0.01, 0.02)}
    heights = np.linspace(0.0, 2.0, 81)
    nodes = {str(i): (0.0, h) for i, h in enumerate(heights)}
    strips = [(str(i), str(i + 1), Section(axial=1e4, bending=5.0, mass=3.0)) for i in range(80)]
    beam = Beam(length=2.0, mass_per_length=3.0, bending_stiffness=5.0, left="clamped", right="free")
    frames = [plane_frame(nodes, strips, fixed=("0",), damping=ModalDamping(0.01), **v) for v in ({}, variation)]
    one, other = (matrix_modes(frame, [], 3).omega for frame in frames)
    beams = [element_modes(beam, np.zeros(0), 3, altered=Alterations(**v)).omega for v in ({}, variation)]
    np.testing.assert_allclose(other / one, beams[1] / beams[0], rtol=2e-5)


def test_a_leaning_strip_bends_and_stretches_as_a_cantilever():
    length, section = 2.0, Section(axial=700.0, bending=5.0, mass=3.0)
    heights = np.linspace(0.0, length, 17)
    nodes = {str(i): (0.6 * h, 0.8 * h) for i, h in enumerate(heights)}
    strips = [(str(i), str(i + 1), section) for i in range(16)]
    frame = plane_frame(nodes, strips, fixed=("0",), damping=ModalDamping(0.01))
    bending = np.sqrt(5.0 / 3.0) / length**2 * np.array([1.875104, 4.694091, 7.854757]) ** 2
    stretching = np.sqrt(700.0 / 3.0) / length * np.pi / 2
    expected = np.sort(np.r_[bending, stretching])[:3]
    np.testing.assert_allclose(matrix_modes(frame, [], 3).omega, expected, rtol=1e-3)


def test_a_stiff_floor_sways_on_two_columns():
    """Two clamped columns give 24 EI / h³; they carry 26/70 of their mass up."""
    column, floor = Section(1e9, 5.0, 0.01), Section(1e9, 1e6, 30.0)
    nodes = {"a": (0.0, 0.0), "b": (0.0, 2.0), "c": (1.0, 2.0), "d": (1.0, 0.0)}
    strips = [("a", "b", column), ("b", "c", floor), ("c", "d", column)]
    frame = plane_frame(nodes, strips, fixed=("a", "d"), damping=ModalDamping(0.01))
    stiffness, mass = 24.0 * 5.0 / 2.0**3, 30.0 + 2 * 13 / 35 * 0.01 * 2.0
    assert matrix_modes(frame, [], 1).omega[0] == pytest.approx(np.sqrt(stiffness / mass), rel=1e-4)


def test_masses_move_in_every_direction_and_springs_act_between_two_points():
    rods = [("ground", "one", Section(6.0, 1.0, 1.0)), ("one", "two", Section(6.0, 1.0, 1.0))]
    nodes = {"ground": (0.0, 0.0), "one": (1.0, 0.0), "two": (2.0, 0.0)}
    frame = plane_frame(nodes, rods, fixed=("ground",), damping=ModalDamping(0.01))
    altered = Alterations(masses=(("two.x", 4.0),), springs=((Between("two.x", "one.x"), 3.0),))
    m, k = np.array([[2.0, 0.5], [0.5, 1.0]]) / 3.0, np.array([[12.0, -6.0], [-6.0, 6.0]])
    m[1, 1] += 4.0
    k += 3.0 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    along = np.sqrt(np.sort(np.linalg.eigvals(np.linalg.solve(m, k)).real))
    found = matrix_modes(frame, ["two.x", Between("two.x", "one.x")], 6, altered=altered)
    for omega in along:
        assert np.abs(found.omega / omega - 1.0).min() < 1e-9
    # the tip bends like a massless cantilever with a tip mass, a little lower for its own mass: 3 EI / (L³ M)
    lowest = found.omega[0]
    assert np.sqrt(3.0 / (8.0 * 5.0)) < lowest < np.sqrt(3.0 / (8.0 * 4.0))
    alone = matrix_modes(frame, ["one.x", "two.x"], 6, altered=altered).shapes
    np.testing.assert_allclose(found.shapes[1], alone[1] - alone[0], atol=1e-12)


# --- trials


def _effect(told: dict, domain) -> Effect:
    values = {name: value for name, value in told.items() if name not in CHANNELS}
    target = told.get("input", told.get("output"))
    if "with" in told or "from" in told:
        target = (target, told.get("with", told.get("from")))
    if told["kind"] == "truncated_modes":
        target, values = values["needed"], {}
    place = place_of(told)
    return Effect(kind_named(told["kind"]), target, {**(place_values(place) if place else {}), **values})


def _check_against_predictor(structure: str, kinds: tuple[str, ...], seed: int) -> None:
    case, label = make_trial(seed, kinds=kinds, structure=structure)
    told = [e for e in label["effects"] if e["kind"] != "none"]
    assert sorted(e["kind"] for e in told) == sorted(kinds)
    rig = apply_all(case.rig, [_effect(e, case.rig.modes.domain) for e in told])
    for record in (*case.fit, *case.validation):
        figures = label["records"][record.name]
        predicted = simulate(rig, record.inputs, sample_time=record.sample_time, substeps=16).outputs
        gap = np.sqrt(np.mean(((record.outputs - predicted) / record.outputs.std(axis=1, keepdims=True)) ** 2))
        # what stands on a frame moves modes beyond those known at its points; friction that all but locks, a little
        share = 0.1 if set(kinds) & ATTACHED else 2e-3 if set(kinds) & LOCKING else 0.0
        left = share * figures["gap"] if structure == "frames" else 0.0
        assert gap == pytest.approx(figures["true_model"], rel=0.05, abs=left), record.name
    if "sensor_quantisation" not in kinds:  # which hides within the noise on some benches
        assert max(f["gap"] / f["noise_floor"] for f in label["records"].values()) > 2.0


@pytest.mark.parametrize(
    "kind", ["cubic_spring", *(pytest.param(k, marks=pytest.mark.slow) for k in ("point_mass", "sensor_misplacement"))]
)
def test_two_numerical_routes_agree_on_a_frame(kind):
    _check_against_predictor("frames", (kind,), seed=5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("structure", "kind"),
    [(s, k) for s in ("plates", "frames") for k in KINDS if k not in NOT_ON[s] | {"random_disturbance"}],
)
def test_two_numerical_routes_agree_of_every_kind(structure, kind):
    _check_against_predictor(structure, (kind,), seed=31)


def test_nothing_hides_where_another_place_moves_alike():
    """The two upper corners of a storey sway as one: along x, no answer could tell them apart."""
    rng = np.random.default_rng(3)
    bench = draw_bench(rng, "frames")
    nominal = NominalMotion.of(bench, experiments(bench, rng)["mid"])
    drawn = [nominal.place(rng, between=i % 2 == 1) for i in range(40)]
    assert any(isinstance(place, Between) for place in drawn) and len(set(map(str, drawn))) > 3
    corners = {f"{side}{k}.6.x" for side in "LR" for k in (1, 2, 3)}
    assert not corners & {place for place in drawn if isinstance(place, str)}


def test_kinds_of_a_member_alone_are_not_drawn_elsewhere():
    for structure in ("plates", "frames"):
        drawn = {kind for kinds in draw_kinds(120, 1, structure=structure) for kind in kinds}
        assert not drawn & NOT_ON[structure] and "ground_spring" in drawn
    with pytest.raises(ValueError, match="members, plates, frames; got 'shells'"):
        draw_bench(np.random.default_rng(0), "shells")


def test_places_on_plates_count_by_the_diagonal_and_names_by_themselves():
    plate, told = Rectangle((3.0, 4.0)), {"kind": "ground_spring", "at": [1.0, 1.0], "parameters": {}}
    hidden = {"effects": [{"kind": "ground_spring", "at": [1.03, 1.04]}]}
    found = score({"effects": [told]}, hidden, domain=plate)
    assert found["position_errors"] == [pytest.approx(0.05 / 5.0)] and found["positions"]
    points = NamedPoints(("a.x", "a.y", "b.x"), np.eye(3), ("x", "y", "x"), ("a", "a", "b"))
    for kind, one, other, right in (
        ("ground_spring", {"at": "a.x"}, {"at": "a.x"}, True),
        ("ground_spring", {"at": "a.x"}, {"at": "a.y"}, False),
        ("point_mass", {"at": "a.x"}, {"at": "a.y"}, True),
        ("bouc_wen", {"between": ["a.x", "b.x"]}, {"between": ["b.x", "a.x"]}, True),
        ("bouc_wen", {"between": ["a.x", "b.x"]}, {"at": "a.x"}, False),
    ):
        verdict = {"effects": [{"kind": kind, **other, "parameters": {}}]}
        assert score(verdict, {"effects": [{"kind": kind, **one}]}, domain=points)["positions"] is right


@pytest.mark.slow
@pytest.mark.parametrize("structure", ["plates", "frames"])
def test_a_small_blind_trial_is_passed(structure):
    held = hold_trials(3, 271, structure=structure, kinds=[("point_damper",), (), ("actuator_gain", "clearance")])
    assert all(s["kinds"] for s in held.scores.values()), held.statistics.counts
    assert held.statistics.misplaced == 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ground_spring", "point_mass", "coulomb_friction"])
def test_what_hides_in_a_cantilever_with_patches_is_named(kind):
    cantilever = {"left": "clamped", "right": "free", "bottom": "free", "top": "free"}
    plate = _plate(cantilever, length=(1.2, 0.8), bending_stiffness=175.0, damping=ModalDamping(0.005))
    patches = [piezo_patch(f"P{i}", at, length=(0.2, 0.15)) for i, at in enumerate([(0.5, 0.24), (0.84, 0.52)])]
    places = [(0.36, 0.56), (0.7, 0.2), (1.1, 0.7), (1.15, 0.1), (0.9, 0.4)]
    sensors = [Sensor(f"a{i}", at, "acceleration") for i, at in enumerate(places)]
    rig = Rig(plate.modes(6), (*patches, Actuator("hammer", (0.9, 0.66), direct=True)), sensors, structure=plate)
    commands = np.zeros((3, 1500))
    commands[:2] = np.repeat(np.random.default_rng(0).normal(size=(2, 500)), 3, axis=1)
    dt = 0.1 / rig.modes.frequencies_hz[4]
    quiet = simulate(rig, commands, sample_time=dt, name="high")
    noise = 2e-3 * quiet.outputs.std(axis=1)
    rig = replace(rig, sensors=[replace(s, noise_std=n) for s, n in zip(rig.sensors, noise, strict=True)])
    like = Case("patches", rig, (quiet,), ())
    held = hold_trials(1, 3, like=like, kinds=[(kind,)])
    (score,) = held.scores.values()
    assert score["kinds"] and score["positions"], held.verdicts
