"""From a bench to a rig in one line: what was identified simulates, and answers to an added mass, as the structure."""

import warnings
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from workbench.draw.plot import plot
from workbench.identification.ambient import AmbientModes
from workbench.identification.driven import identify_driven
from workbench.identification.frf import identify_frf
from workbench.identification.rig_from import rig_from
from workbench.identification.ring_down import ring_down
from workbench.identification.signal.clocks import CLOCKS, far_from_real
from workbench.identification.signal.synthesis import free_decay
from workbench.records.record import Channel
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import MEASURED, Sensor
from workbench.rig.simulate import simulate
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam
from workbench.structure.modes import SampledModes
from workbench.structure.modification import attach
from workbench.structure.plate import Plate
from workbench.structure.supports import PointMass

DT, NOISE = 0.02, 1e-4
PLACES = (0.9, 1.7, 2.6, 3.4)


@pytest.fixture(scope="module")
def bench():
    """A hinged beam that shows three modes, driven at 0.9 m, where a sensor stands too."""
    beam = Beam(
        length=4.0,
        mass_per_length=1.5,
        bending_stiffness=20.0,
        left="hinged",
        right="hinged",
        damping=ModalDamping((0.02, 0.015, 0.01)),
    )
    sensors = tuple(Sensor(f"d{i + 1}", x, noise_std=NOISE) for i, x in enumerate(PLACES))
    return Rig(beam.modes(3), (Actuator("F", 0.9),), sensors)


@pytest.fixture(scope="module")
def found(bench):
    rng = np.random.default_rng(8)
    record = simulate(bench, rng.normal(size=(1, 3000)), sample_time=DT)
    noisy = type(record)(
        sample_time=DT,
        outputs=record.outputs + NOISE * rng.normal(size=record.outputs.shape),
        output_channels=record.output_channels,
        inputs=record.inputs,
        input_channels=record.input_channels,
    )
    return identify_driven(noisy, at_rest=True, feedthrough=False)


def test_the_rig_of_identified_modes_simulates_what_the_structure_does(bench, found):
    rig = rig_from(found)
    inputs = np.random.default_rng(9).normal(size=(1, 1500))
    exact = simulate(bench, inputs, sample_time=DT).outputs
    ours = simulate(rig, inputs, sample_time=DT).outputs
    assert np.abs(ours - exact).max() < 0.01 * np.abs(exact).max()
    assert rig.modes.covariance.shape == (6, 6)
    assert [s.noise_std for s in rig.sensors] == pytest.approx([NOISE] * 4, rel=0.1)


def test_a_driving_point_scales_the_shapes_so_that_a_mass_changes_the_modes_as_it_should(bench, found):
    rig = rig_from(found)
    changed = attach(rig.modes, (PointMass("d3", 0.8),))
    expected = attach(bench.modes, (PointMass(2.6, 0.8),))
    assert abs(expected.omega / bench.modes.omega - 1).max() > 0.05
    np.testing.assert_allclose(changed.omega, expected.omega, rtol=2e-3)


def test_points_of_a_plate_keep_their_places_and_answer_to_a_mass_as_the_plate():
    plate = Plate(length=(0.6, 0.4), mass_per_area=8.0, bending_stiffness=170.0, poisson_ratio=0.3, edges="clamped",
                  damping=ModalDamping(0.01)).modes(2)  # fmt: skip
    at, rng = ((0.2, 0.15), (0.4, 0.12), (0.25, 0.3)), np.random.default_rng(2)
    sensors = tuple(Sensor(f"v{i + 1}", place, "velocity") for i, place in enumerate(at))
    rig = Rig(plate, (Actuator("F", at[0]),), sensors)
    record = simulate(rig, rng.standard_normal((1, 1500)), sample_time=0.2 / plate.frequencies_hz[-1])
    noise = 1e-3 * record.outputs.std() * rng.standard_normal(record.outputs.shape)
    found = rig_from(identify_driven(replace(record, outputs=record.outputs + noise), at_rest=True, feedthrough=False))
    points = found.modes.domain
    assert points.names == ("F", "v1", "v2", "v3") and points.directions == ("z",) * 4
    np.testing.assert_allclose(points.positions, [(*place, 0.0) for place in (at[0], *at)])
    changed, expected = attach(found.modes, (PointMass("v2", 0.1),)), attach(plate, (PointMass(at[1], 0.1),))
    assert abs(expected.omega / plate.omega - 1).max() > 0.02
    np.testing.assert_allclose(changed.omega, expected.omega, rtol=2e-3)
    plot(found.modes).draw_without_rendering()


def test_a_first_response_that_noise_hides_is_no_delay(bench):
    """Of a held force the next sample feels little: it was said to act a whole sample late, and shapes were far off."""
    rng = np.random.default_rng(10)
    quiet = simulate(bench, rng.normal(size=(1, 400)), sample_time=0.05)
    noise = 0.002 * rng.normal(size=(2, *quiet.outputs.shape))[1]
    record = replace(quiet, outputs=quiet.outputs + noise)
    found = identify_driven(record, at_rest=True, feedthrough=False, max_modes=3)
    assert not found.delays.any() and not found.remarks


def accelerations(left, right, forces, n_modes=4):
    """A free or hinged beam and what was identified of its response to forces, noise a five-hundredth of it."""
    beam = Beam(
        length=4.0, mass_per_length=1.5, bending_stiffness=20.0, left=left, right=right, damping=ModalDamping(0.01)
    ).modes(n_modes)
    sensors = tuple(Sensor(f"a{i + 1}", x, "acceleration") for i, x in enumerate(PLACES))
    bench = Rig(beam, tuple(Actuator(f"F{x:g}", x) for x in forces), sensors)
    rng = np.random.default_rng(1)
    inputs = rng.normal(size=(len(forces), 1000))
    record = simulate(bench, inputs, sample_time=0.25 / beam.frequencies_hz[-1], input_hold="first")
    noise = 0.002 * record.outputs.std(axis=1, keepdims=True) * rng.normal(size=record.outputs.shape)
    record = replace(record, outputs=record.outputs + noise)
    return record, identify_driven(record, at_rest=True, max_modes=n_modes)


def error_of(rig, record):
    ours = simulate(rig, record.inputs, sample_time=record.sample_time, input_hold="first").outputs
    return np.sqrt(((ours - record.outputs) ** 2).mean() / (record.outputs**2).mean())


def test_a_beam_that_turns_about_its_hinge_keeps_its_rigid_mode():
    """φ = (3 / m L³)^½ x, of the moment of inertia m L³ / 3; it was left in the direct term."""
    record, found = accelerations("hinged", "free", [0.9])
    rig = rig_from(found)
    assert rig.modes.omega[0] == 0.0 and (rig.modes.omega[1:] > 0).all()
    rigid = np.sqrt(3.0 / (1.5 * 4.0**3)) * np.array(PLACES)
    off = np.abs(rig.modes.phi(["a1", "a2", "a3", "a4"])[:, 0]) - rigid
    np.testing.assert_allclose(off, 0.0, atol=0.01 * rigid.max())
    assert (np.abs(off) < 5.0 * np.sqrt(np.diag(rig.modes.shape_covariance[0]))[1:] + 5e-3 * rigid).all()
    assert error_of(rig, record) < 0.01


def test_a_free_beam_is_right_for_the_forces_that_moved_it():
    record, found = accelerations("free", "free", [0.9, 2.6], n_modes=5)
    with pytest.warns(UserWarning, match="2 rigid modes"):
        rig = rig_from(found)
    assert np.count_nonzero(rig.modes.omega == 0.0) == 2 and error_of(rig, record) < 0.01


def test_a_beam_that_is_held_has_no_rigid_mode():
    _, found = accelerations("clamped", "free", [0.9])
    assert (rig_from(found).modes.omega > 0).all()


def test_rigid_motion_that_cannot_be_placed_is_said_to_be_left_out():
    record, found = accelerations("hinged", "free", [0.9])
    relabelled = [*record.output_channels[:3], Channel("a4", "displacement")]
    with pytest.warns(UserWarning, match="may be rigid-body motion, which outputs of other"):
        assert (rig_from(found, outputs=relabelled).modes.omega > 0).all()


@pytest.mark.parametrize("quantity", ["displacement", "velocity", "acceleration"])
@pytest.mark.parametrize("dashpot", [0.0, 15.0])
def test_frfs_of_a_free_structure_keep_its_rigid_mode(quantity, dashpot):
    """Two masses and a spring, held by nothing but a dashpot: φ = 1 / (m_1 + m_2)^½ of the rigid mode."""
    mass, stiffness = np.diag([1.0, 2.0]), 1e4 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    hz, order = np.arange(4.0, 60.0, 0.1), MEASURED[quantity][1]
    s = 2j * np.pi * hz[:, None, None]
    dynamic = s**2 * mass + s * (1e-4 * stiffness + np.diag([0.0, dashpot])) + stiffness
    h = np.moveaxis(s**order * np.linalg.inv(dynamic), 0, 2)[:, :1]
    noise = np.random.default_rng(0).normal(size=(2, *h.shape))
    h = h + 1e-4 * np.abs(h).mean() * (noise[0] + 1j * noise[1])
    channels = (Channel("a", quantity), Channel("b", quantity))
    found = identify_frf(h, hz, channels=channels)
    with pytest.warns(UserWarning, match="is taken for rigid-body modes at 0 Hz"):
        rig = rig_from(found, inputs=["a"], outputs=channels)
    assert rig.modes.omega[0] == 0.0 and rig.modes.omega.size == 2
    np.testing.assert_allclose(np.abs(rig.modes.phi(["a", "b"])[:, 0]), 3.0**-0.5, rtol=0.02)


@pytest.mark.parametrize(("lowest", "stiff", "said"), [(2.0, 0.0, None), (30.0, 0.0, "modes below the lowest line"),
                                                      (2.0, 0.1, "modes above 199.5 Hz")])  # fmt: skip
def test_modes_beyond_the_band_are_said_to_be_left_out_where_they_matter(lowest, stiff, said):
    """A hinged beam, its first mode at 7.3 Hz, by its closed form, and a flexibility of no mode of the band; none of
    its modes is taken for a rigid one."""
    hz, r = np.arange(lowest, 200.0, 0.5), np.arange(1, 20)
    s, omega = 2j * np.pi * hz, 2.0 * np.pi * 7.3 * r[:, None] ** 2
    phi = np.sqrt(2.0) * np.sin(np.pi * np.outer([0.11, 0.23, 0.37, 0.52], r))
    h = (phi * phi[0]) @ (1.0 / (s**2 + 0.01 * omega * s + omega**2))
    h = h + stiff * np.abs(h).max()
    noise = np.random.default_rng(0).normal(size=(2, *h.shape))
    h = h + 1e-3 * np.abs(h).mean(axis=1, keepdims=True) * (noise[0] + 1j * noise[1])
    channels = tuple(Channel(f"p{k}", "displacement") for k in range(4))
    found = identify_frf(h, hz, channels=channels)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        rig = rig_from(found, inputs=["p0"], outputs=channels)
    assert (rig.modes.omega > 0).all()
    assert [said in str(w.message) for w in caught] == [True] if said else not caught


@pytest.mark.slow
def test_the_spread_of_shapes_over_many_records_is_what_their_covariance_says(bench):
    rng = np.random.default_rng(10)
    inputs = rng.normal(size=(1, 400))
    quiet = simulate(bench, inputs, sample_time=0.05)
    loud = [replace(quiet, outputs=quiet.outputs + 0.002 * rng.normal(size=quiet.outputs.shape)) for _ in range(80)]
    rigs = [rig_from(identify_driven(record, at_rest=True, feedthrough=False, max_modes=3)) for record in loud]
    points = rigs[0].modes.domain.names
    exact = np.array([bench.modes.phi(0.9)[0], *bench.modes.phi(PLACES)])
    assert points == ("F", "d1", "d2", "d3", "d4")
    off = np.array(
        [rig.modes.phi(points) * np.sign((rig.modes.phi(points) * exact).sum(axis=0)) - exact for rig in rigs]
    )
    for r in range(3):
        by_record = [
            errors[:, r] @ np.linalg.solve(rig.modes.shape_covariance[r][1:, 1:], errors[:, r])
            for errors, rig in zip(off[:, 1:], rigs)
        ]
        # of χ² with 4 degrees of freedom, the mean of 80 of them: 4 ± 3 of its standard errors
        assert np.mean(by_record) == pytest.approx(4.0, abs=3.0 * np.sqrt(8.0 / 80))


def test_modes_that_nothing_scales_are_said_so(found):
    elsewhere = [Channel(c.name, c.quantity) for c in found.output_channels]
    with pytest.warns(UserWarning, match="the shapes have no scale") as told:
        rig_from(found, outputs=elsewhere)
    assert told[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scaled = rig_from(found)
        largest = np.abs(scaled.modes.phi(["d1", "d2", "d3", "d4"])).max(axis=0)
        by_mass = rig_from(found, outputs=elsewhere, modal_masses=1.0 / largest**2)
    np.testing.assert_allclose(
        np.abs(by_mass.modes.phi(["d1", "d2", "d3", "d4"])),
        np.abs(scaled.modes.phi(["d1", "d2", "d3", "d4"])),
        rtol=1e-6,
    )


def test_output_only_modes_need_modal_masses(found):
    modes = SampledModes([2.0, 5.0], [0.01, 0.02], [[0.5, 1.0], [1.0, -0.25]], [np.nan, np.nan])
    ambient = AmbientModes(modes, np.eye(4), np.ones(2), 0.0, ())
    channels = (Channel("a", "displacement"), Channel("b", "displacement"))
    with pytest.raises(ValueError, match="no scale; give modal_masses"):
        rig_from(ambient, outputs=channels)
    rig = rig_from(ambient, outputs=channels, modal_masses=[4.0, 0.25], inputs=["b"])
    np.testing.assert_allclose(rig.modes.phi(["a", "b"]), [[0.25, 2.0], [0.5, -0.5]])
    assert rig.actuators[0].at == "b"


def test_what_does_not_fit_is_refused(found):
    with pytest.raises(ValueError, match=r"driving_point is \(input, output\), of F and d1, d2, d3, d4"):
        rig_from(found, driving_point=("F", "d9"))
    with pytest.raises(ValueError, match="negative mass at the driving point"):
        rig_from(found, driving_point=("F", "d4"))
    with pytest.raises(ValueError, match="must name the 4 outputs"):
        rig_from(found, outputs=[Channel("only", "displacement")])


def test_a_rig_of_output_only_modes_has_the_errors_of_shapes_and_warns_of_complex_ones():
    modes = SampledModes([8.0, 30.0], [0.01, 0.02], [[1.0, 0.5], [0.3, -0.8]], [0.0, 1.0])
    record = free_decay(modes, sample_time=0.02, n_samples=600, noise_std=0.005)
    found = ring_down(record)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rig = rig_from(found, modal_masses=[4.0, 0.25])
    np.testing.assert_allclose(
        rig.modes.shape_covariance, found.shape_covariance / np.array([4.0, 0.25])[:, None, None]
    )
    turned = SampledModes(modes.omega, modes.zeta, modes.shapes * [[1.0, 1.0], [1j, 1.0]], modes.positions)
    with pytest.warns(
        UserWarning, match=r"mode 1 at 1.273 Hz is complex: the nearest real mode differs from its shape by 29 %"
    ) as told:
        rig_from(AmbientModes(turned, np.eye(4), np.ones(2), 0.0, ()), outputs=record.output_channels, modal_masses=1.0)
    assert told[0].filename == __file__


def test_a_shape_that_may_be_complex_by_its_noise_is_not_warned_of():
    """In noise the nearest real shape leaves 12 %, and its error is 15 %."""
    modes = SampledModes([8.0, 30.0], [0.01, 0.02], [[1.0, 0.05], [0.3, -0.08]], [0.0, 1.0])
    found = ring_down(free_decay(modes, sample_time=0.02, n_samples=600, noise_std=0.05, seed=4), n_modes=2)
    assert far_from_real(found.modes)[1] > CLOCKS.min_shape_distance
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rig_from(found, modal_masses=1.0)


def test_one_mode_of_two_set_ups_is_no_pair():
    """Two roving sensors: their mass lowers the frequencies of a chain, M s² + C s + K, in the second set-up."""
    n, f = 4, np.arange(5.0, 60.0, 0.25)
    stiffness = 4e4 * (2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))

    def receptance(added, rows):
        mass = np.diag(2.0 + np.array(added))
        s = 2j * np.pi * f
        each = [np.linalg.inv(mass * x**2 + (5e-5 * stiffness) * x + stiffness) * x**2 for x in s]
        return np.moveaxis(np.array(each), 0, -1)[rows, :1]

    channels = tuple(Channel(f"y{i}", "acceleration") for i in range(n))

    def identified(*set_ups):
        h = np.concatenate([receptance(added, rows) for added, rows in set_ups])
        size = 3e-3 * np.sqrt((np.abs(h) ** 2).mean(axis=-1, keepdims=True))
        noise = np.random.default_rng(0).standard_normal((2, *h.shape))
        return identify_frf(h + size * (noise[0] + 1j * noise[1]), f, channels=channels)

    bare, loaded = ([0.0] * 4, slice(2)), ([0.0, 0.0, 0.08, 0.05], slice(2, 4))
    force = [Channel("F", "force")]
    both = identified(bare, loaded)
    assert both.modes.n_modes == 2 * n and any("share no sensor" in remark for remark in both.remarks)
    with pytest.warns(UserWarning, match="share no sensor"), suppress(ValueError):
        rig_from(both, inputs=force, outputs=channels, driving_point=("F", "y0"))
    alone = identified(([0.0] * 4, slice(4)))
    assert alone.modes.n_modes == n and not any("share no sensor" in remark for remark in alone.remarks)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rig_from(alone, inputs=force, outputs=channels, driving_point=("F", "y0"))
