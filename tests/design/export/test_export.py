"""A design that leaves the workbench does there what it does here."""

import ctypes
import runpy
import shutil
import subprocess
from dataclasses import replace

import control
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.io import loadmat
from scipy.signal import cont2discrete

from workbench.design.estimation.controller import Controller
from workbench.design.estimation.digital import DigitalController, FrictionFeedforward, Relays, sampled
from workbench.design.estimation.observers import kalman_controller, luenberger_controller
from workbench.design.export.export import export, write_controller
from workbench.design.export.sampled import sample_design
from workbench.design.export.sampled_loop import sampled_loop
from workbench.design.export.source import command_words, reading_words
from workbench.design.laws.coupled import coupled_lqr
from workbench.design.laws.imsc import imsc
from workbench.design.laws.law import DesignError, Law
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.rig.statespace import state_space
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import Interval
from workbench.structure.member import Beam
from workbench.structure.modes import Modes

RATE = 200.0
ACTUATORS = (Actuator("F1", 0.45), Actuator("F2", 1.2, gain=0.7, time_constant=0.004))
SENSORS = (Sensor("d1", 0.3), Sensor("v2", 1.7, "velocity"))
COMPILER = shutil.which("cc")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler, cc, on this machine")


@pytest.fixture(scope="module")
def modes(hinged_beam):
    return hinged_beam.modes(5)


@pytest.fixture(scope="module")
def observer(modes):
    law = imsc(modes, 2, ACTUATORS, weight=1.0)
    return luenberger_controller(modes, law, SENSORS, poles=modes.omega[:2] * (-0.3 + 1j))


def everything(rng) -> DigitalController:
    """A controller that makes up for all that one can."""
    n, ny, nu = 4, 2, 2
    a = rng.standard_normal((n, n))
    return DigitalController(
        0.01, ("y1", "y2"), ("F1", "F2"),
        0.9 * a / np.abs(np.linalg.eigvals(a)).max(), rng.standard_normal((n, ny)), rng.standard_normal((nu, n)),
        rng.standard_normal((nu, ny)), 0.1 * rng.standard_normal((n, nu)), offset=np.array([0.1, -0.3]),
        scale=np.array([1.1, 0.9]), limit=np.array([2.0, np.inf]), rate=np.array([np.inf, 0.8]),
        dead_zone=np.array([0.0, 0.2]), bias=np.array([0.05, 0.0]),
        friction=FrictionFeedforward(
            rng.standard_normal((nu, 1)), rng.standard_normal((1, n)), rng.standard_normal((1, ny)), np.array([0.3]),
            np.array([0.1]),
        ),
        name="all at once",
    )  # fmt: skip


def switching(rng) -> DigitalController:
    """A modal filter with relays, so without states."""
    relays = Relays(rng.standard_normal((2, 3)), np.array([1.0, 2.0, 0.5]), np.array([0.3, 0.5, 0.0]))
    none = np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((3, 0)), rng.standard_normal((3, 2)), np.zeros((0, 2))
    return DigitalController(0.01, ("y1", "y2"), ("F1", "F2"), *none, relays=relays, name="on-off")


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_channels_close_to_one_another_are_told_apart_in_any_unit(unit):
    domain, near = Interval(2.0 * unit), (1.3412 * unit, 1.3415 * unit)
    words = command_words(domain, [Actuator("F", at) for at in near])
    words += reading_words(domain, [Sensor("y", at) for at in near])
    assert len(set(words)) == 4 and all(f"x = {at:g}" in text for at, text in zip(near * 2, words))


def test_a_command_has_the_unit_of_what_it_does():
    """The force itself, but for a gain: then a volt, say, makes so much of it."""
    drives = [Actuator("F", 0.5), Actuator("M", 0.5, "moment"), Actuator("V", 0.5, "moment", gain=2.5)]
    assert command_words(Interval(2.0), drives) == (
        "F: force at x = 0.5, N",
        "M: moment at x = 0.5, N m",
        "V: command at x = 0.5, 2.5 N m per unit",
    )


def stepped(controller: DigitalController, readings: np.ndarray) -> np.ndarray:
    z, before, commands = np.zeros(controller.A.shape[0]), np.zeros(len(controller.actuators)), []
    for reading in readings.T:
        command, before, z = controller.step(z, before, reading)
        commands.append(command)
    return np.array(commands).T


def compiled(path, readings: np.ndarray, n_commands: int) -> np.ndarray:
    """What the C function commands, compiled as strictly as can be."""
    library = path.with_suffix(".so")
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-pedantic", "-Werror", "-shared", "-fPIC"]
    subprocess.run([COMPILER, *flags, path, "-lm", "-o", library], check=True)
    code = ctypes.CDLL(str(library))
    state, doubles = ctypes.create_string_buffer(4096), ctypes.POINTER(ctypes.c_double)
    getattr(code, f"{path.stem}_reset")(state)
    step, command, commands = getattr(code, f"{path.stem}_step"), np.zeros(n_commands), []
    for reading in np.ascontiguousarray(readings.T):
        step(state, reading.ctypes.data_as(doubles), command.ctypes.data_as(doubles))
        commands.append(command.copy())
    return np.array(commands).T


def interpreted(path, readings: np.ndarray) -> np.ndarray:
    one = runpy.run_path(str(path))["Controller"]()
    return np.array([one.step(reading) for reading in readings.T.tolist()]).T


def from_mat(path, readings: np.ndarray) -> np.ndarray:
    """What the variables of a MAT file command by the equations of the how-to."""
    m = {name: value for name, value in loadmat(path).items() if not name.startswith("__")}
    row = {name: value.ravel() for name, value in m.items() if min(np.shape(value)) == 1}
    z, v, commands = np.zeros(len(m["A"])), np.zeros(len(row["limit"])), []
    for reading in readings.T:
        y = row["scale"] * (reading - row["offset"])
        w = m["C"] @ z + m["D"] @ y
        if "relay_force" in m:
            w = -m["relay_allocation"] @ (row["relay_force"] * np.sign(w) * (np.abs(w) > row["relay_dead_band"]))
        if "friction_force" in m:
            speed = m["friction_of_state"] @ z + m["friction_of_reading"] @ y
            w = w + m["friction_gain"] @ (m["friction_force"][0] * np.tanh(speed / m["friction_smoothing"][0]))
        w = np.minimum(np.maximum(w, -row["limit"]), row["limit"])
        v = np.minimum(np.maximum(w, v - row["rate"]), v + row["rate"])
        commands.append(v + row["dead_zone"] * np.minimum(np.maximum(v / row["onset"], -1), 1) - row["bias"])
        z = m["A"] @ z + m["B"] @ y + m["E"] @ v
    return np.array(commands).T


def error(found: np.ndarray, true: np.ndarray) -> float:
    return float(np.abs(found - true).max() / np.abs(true).max())


@needs_compiler
def test_an_exported_controller_commands_what_python_control_simulates(modes, observer, tmp_path):
    readings = np.random.default_rng(1).standard_normal((2, 10_000))
    design = export(modes, observer, tmp_path / "arm.c", sample_rate_hz=RATE)
    export(modes, observer, tmp_path / "arm.py", sample_rate_hz=RATE)
    time = np.arange(10_000) / RATE
    true = control.forced_response(design.controller.state_space(), time, readings).outputs
    assert error(compiled(tmp_path / "arm.c", readings, 2), true) < 1e-12
    assert error(interpreted(tmp_path / "arm.py", readings), true) < 1e-12


@needs_compiler
@pytest.mark.parametrize("make", [everything, switching])
def test_what_a_controller_makes_up_for_is_exported_too(make, tmp_path):
    rng = np.random.default_rng(2)
    controller, readings = make(rng), rng.standard_normal((2, 10_000))
    true = stepped(controller, readings)
    (tmp_path / "py").mkdir()
    write_controller(controller, tmp_path / "arm.c")
    write_controller(controller, tmp_path / "py" / "arm.py")
    assert error(compiled(tmp_path / "arm.c", readings, 2), true) < 1e-12
    assert error(interpreted(tmp_path / "py" / "arm.py", readings), true) < 1e-12


@pytest.mark.parametrize("make", [everything, switching])
def test_a_mat_file_holds_all_that_the_step_needs(make, tmp_path):
    rng = np.random.default_rng(2)
    controller, readings = make(rng), rng.standard_normal((2, 10_000))
    write_controller(controller, tmp_path / "arm.mat")
    assert error(from_mat(tmp_path / "arm.mat", readings), stepped(controller, readings)) < 1e-12


@needs_compiler
def test_names_cannot_end_a_comment(tmp_path):
    none = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.ones((1, 1)), np.zeros((0, 1))
    wild = DigitalController(0.1, ('*/ int x = "\\" """\nimport os',), ("F*/",), *none, name='"""*/\n#error')
    write_controller(wild, tmp_path / "a.c")
    write_controller(wild, tmp_path / "a.py")
    readings = np.arange(3.0)[None]
    assert (compiled(tmp_path / "a.c", readings, 1) == readings).all()
    assert (interpreted(tmp_path / "a.py", readings) == readings).all()


def test_the_controller_is_held_over_each_sample_as_scipy_does_it(modes, observer, tmp_path):
    design = export(modes, observer, tmp_path / "arm.mat", sample_rate_hz=RATE)
    a, b, c, d, _ = cont2discrete((observer.A, observer.B, observer.C, observer.D), 1 / RATE)
    written = loadmat(tmp_path / "arm.mat", squeeze_me=True)
    for found in (design.controller.state_space(), control.ss(*(written[k] for k in "ABCD"), written["sample_time"])):
        for matrix, true in zip((found.A, found.B, found.C, found.D), (a, b, c, d)):
            np.testing.assert_allclose(matrix, true, atol=1e-12 * max(np.abs(true).max(), 1.0))
    assert [text.split(":")[0] for text in written["readings"]] == ["d1", "v2"]
    assert len(written["states"]) == 4


@pytest.mark.parametrize(("late", "crosstalk"), [(0.0, ()), (0.3, ()), (1.0, ()), (2.6, ()), (0.3, (("v2", 0.2),))])
def test_the_sampled_loop_is_that_of_the_differential_equation(modes, observer, late, crosstalk):
    period = 1 / RATE
    digital = export(modes, observer, sample_rate_hz=RATE).controller
    sensors = [replace(SENSORS[0], crosstalk=crosstalk), SENSORS[1]]
    matrix = sampled_loop(modes, ACTUATORS, sensors, digital, late * period)
    plant = state_space(modes, ACTUATORS, SENSORS)
    mixed = np.eye(2) + [[0.0, dict(crosstalk).get("v2", 0.0)], [0.0, 0.0]]
    n = plant.nstates
    x, z = np.random.default_rng(3).standard_normal(n), np.zeros(4)
    found = np.linalg.matrix_power(matrix, 6) @ np.r_[x, np.zeros(matrix.shape[0] - n)]
    whole, rest = int(late), late - int(late)
    past = [np.zeros(2)] * 4
    for _ in range(6):
        y = mixed @ plant.C @ x
        command, z = digital.C @ z + digital.D @ y, digital.A @ z + digital.B @ y
        past = [command, *past]
        for held, span in ((past[whole + 1], rest * period), (past[whole], (1 - rest) * period)):
            if span > 0:

                def moving(_, s, u=held):
                    return plant.A @ s + plant.B @ u

                x = solve_ivp(moving, (0, span), x, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(np.r_[found[:n], found[-4:]], np.r_[x, z], atol=1e-9)


def test_the_delay_margin_is_that_of_the_bode_plot():
    # u = -g q' on q'' + q = u: |L| = 1 at ω² - 1 = g ω, 90° from instability; a fast sample takes half of itself away
    omega, gain, period = 1.0, 0.4, 0.02
    modes = Modes(np.array([omega]), np.array([0.0]), lambda x, k: np.ones((np.size(x), 1)), 1.0)
    law = Law(np.array([[0.0, gain]]), (0,), (Actuator("F", 0.5),))
    empty = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0))
    controller = Controller(law, (Sensor("v", 0.5, "velocity"),), *empty, np.array([[-gain]]), "rate feedback")
    crossing = 0.5 * gain + np.sqrt(0.25 * gain**2 + omega**2)
    bears = 0.5 * np.pi / crossing - 0.5 * period
    design = export(modes, controller, sample_rate_hz=1 / period, computing_delay=bears - 0.02)
    assert design.delay_margin == pytest.approx(0.02, abs=1e-4)
    assert design.phase_lag == pytest.approx([omega * (0.5 * period + bears - 0.02)])
    with pytest.warns(DeprecationWarning, match="phase_lag"):
        assert design.phase_lost == design.phase_lag


def test_a_rate_too_slow_is_refused_with_one_that_holds(modes, observer):
    with pytest.raises(DesignError, match=r"too slow for mode 2 at 3\.142 Hz.* sample at 32 Hz"):
        export(modes, observer, sample_rate_hz=6.0)
    with pytest.raises(DesignError, match=r"sample at [0-9.]+ Hz or more") as refused:
        export(modes, observer, sample_rate_hz=25.0, computing_delay=0.055)
    rate = float(str(refused.value).split("sample at ")[1].split()[0])
    assert export(modes, observer, sample_rate_hz=rate, computing_delay=0.055).decay_rate > 0


def test_what_cannot_be_handed_over_is_refused_with_the_remedy(modes, observer, tmp_path):
    with pytest.raises(DesignError, match="put it on an observer"):
        export(modes, observer.law, sample_rate_hz=RATE)
    with pytest.raises(DesignError, match="must be positive"):
        export(modes, observer, sample_rate_hz=0.0)
    with pytest.raises(DesignError, match="computing delay must be 0 s or more"):
        export(modes, observer, sample_rate_hz=RATE, computing_delay=-1e-3)
    with pytest.raises(DesignError, match="destabilise"):
        export(modes, observer, sample_rate_hz=RATE, computing_delay=0.3)
    with pytest.raises(DesignError, match=r"the delay of a command is .* samples"):
        export(modes, observer, sample_rate_hz=RATE, computing_delay=10.0)
    with pytest.raises(ValueError, match=r"written as \.c, \.py or \.mat"):
        export(modes, observer, tmp_path / "arm.cpp", sample_rate_hz=RATE)
    with pytest.raises(ValueError, match="cannot name a function"):
        export(modes, observer, tmp_path / "2arm.c", sample_rate_hz=RATE)
    for wrong, match in (
        ({"sample_rate_hz": "100"}, "sample_rate_hz is a number in Hz; got '100'"),
        ({"sample_rate_hz": RATE, "computing_delay": None}, "computing_delay is a number in s; got None"),
    ):
        with pytest.raises(TypeError, match=match):
            export(modes, observer, **wrong)
    with pytest.raises(TypeError, match=r"got DigitalController: .* sampled already, write_controller writes it"):
        export(modes, sampled(observer, 0.01), sample_rate_hz=RATE)
    with pytest.raises(TypeError, match="modes must be Modes; got str"):
        export("modes", observer, sample_rate_hz=RATE)
    with pytest.raises(TypeError, match="the controller must be a law on an estimator; got Law"):
        sampled(observer.law, 0.01)
    with pytest.raises(ValueError, match=r"above 0; got -0\.01"):
        sampled(observer, -0.01)
    fierce = imsc(modes, 2, ACTUATORS, weight=1e-4)
    unstable = luenberger_controller(modes, fierce, SENSORS, poles=20 * modes.omega[:2] * (-0.3 + 1j))
    with pytest.raises(DesignError, match=r"unstable in continuous time.*Kalman filter by less disturbance"):
        export(modes, unstable, sample_rate_hz=1e4)


def test_a_slow_actuator_is_in_the_margin_of_continuous_time():
    """A lag that stabilises: the loop without it grows, and was refused."""
    beam = Beam(
        length=1.7, mass_per_length=0.9, bending_stiffness=13.0, left="clamped", right="free",
        damping=ModalDamping(0.002),
    )  # fmt: skip
    modes, drive = beam.modes(6), Actuator("a", 0.80816, time_constant=0.076105)
    law = coupled_lqr(modes, 1, [drive], weight=0.0014165)
    sensors = [Sensor("y", 1.46274)]
    controller = kalman_controller(modes, law, sensors, disturbance=1.0, noise=1.0374e-6)
    parts = (controller.A, controller.B, controller.C, controller.D)
    true = control.feedback(state_space(modes, [drive], sensors), control.ss(*parts), sign=1).poles().real.max()
    found = sample_design(modes, controller, sample_rate_hz=2000.0)
    assert true < 0 and f"{-true:.3g} 1/s in continuous time" in found.remarks[0]


def test_the_sampled_loop_has_the_cross_talk_of_actuators(modes, observer):
    """It precedes their delays, which differ: as a controller whose commands are mixed by hand."""
    digital = export(modes, observer, sample_rate_hz=RATE).controller
    late = [replace(a, delay=delay / RATE) for a, delay in zip(ACTUATORS, (0.4, 1.3), strict=True)]
    leaking = [replace(late[0], crosstalk=(("F2", 0.3),)), replace(late[1], crosstalk=(("F1", -0.2),))]
    mix = np.array([[1.0, 0.3], [-0.2, 1.0]])
    by_hand = replace(digital, C=mix @ digital.C, D=mix @ digital.D, E=digital.E @ np.linalg.inv(mix))
    expected = sampled_loop(modes, late, SENSORS, by_hand)
    np.testing.assert_allclose(
        sampled_loop(modes, leaking, SENSORS, digital), expected, atol=1e-12 * np.abs(expected).max()
    )
    assert np.abs(sampled_loop(modes, late, SENSORS, digital) - expected).max() > 1e-3
