"""Which term does a linear model of the Silverbox lack? Fitted on multisines, checked on others and on the arrow."""

from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scipy.optimize import least_squares

from workbench.draw.gap import plot_budget, plot_unmodelled_force
from workbench.gap.diagnose import diagnose
from workbench.records.record import Channel, Record
from workbench.records.units import Units
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes, PointShapes

NEEDS_DATA = "SNLS80mV.mat of the Silverbox benchmark"
SAMPLE_TIME = 2**14 / 1e7
ARROW = slice(0, 40000)
FIRST, PERIOD = 40560, 8692  # the ten multisines with the zeros before them
TRANSIENT = 1.0  # s; a multisine starts while the one before still rings
RESOLUTION = 0.4e-3  # V: what a model of an electronic circuit is asked to explain


def held_equivalent(u):
    """The input to hold over each interval whose content below half the sample rate is that of the sampled signal.

    Holding multiplies a spectrum by sinc(f Δt) and delays it by half a sample; both are taken back.
    """
    phase = np.pi * np.fft.rfftfreq(u.size)
    return np.fft.irfft(np.fft.rfft(u) * np.exp(1j * phase) / np.sinc(phase / np.pi), n=u.size)


def linear_rig(omega, zeta, stiffness):
    """One degree of freedom, from input volt to output volt."""
    shapes = PointShapes(np.full((2, 1), omega / np.sqrt(stiffness)))
    modes = Modes(omega=[omega], damping=[zeta], shapes=shapes, domain=NamedPoints(("V1", "V2")))
    return Rig(modes, (Actuator("V1", "V1"),), (Sensor("V2", "V2", noise_std=RESOLUTION),))


def best_linear(record):
    """The linear model of least squared error on a record."""
    lead = round(TRANSIENT / SAMPLE_TIME)

    def residual(p):
        rig = linear_rig(*np.exp(p))
        return (record.outputs - simulate(rig, record.inputs, sample_time=SAMPLE_TIME).outputs)[0, lead:] / RESOLUTION

    start = np.log([2 * np.pi * 68.3, 0.049, 1.0])
    return linear_rig(*np.exp(least_squares(residual, start, x_scale=0.01).x))


def rmse(rig, record, transient):
    lead = round(transient / SAMPLE_TIME)
    error = record.outputs - simulate(rig, record.inputs, sample_time=SAMPLE_TIME).outputs
    return float(np.sqrt(np.mean(error[0, lead:] ** 2)))


def study(outcome, data: Path) -> None:
    file = loadmat(data)
    u, y = (file[name].ravel() - file[name].mean() for name in ("V1", "V2"))
    u = held_equivalent(u)

    def record(name, piece):
        return Record(
            sample_time=SAMPLE_TIME,
            outputs=y[None, piece],
            output_channels=(Channel("V2", "voltage"),),
            inputs=u[None, piece],
            input_channels=(Channel("V1", "voltage"),),
            name=name,
        )

    lead = round(TRANSIENT / SAMPLE_TIME)
    fitted = record("multisines 1-5", slice(FIRST, FIRST + 5 * PERIOD))
    held_out = record("multisines 6-10", slice(FIRST + 5 * PERIOD - lead, FIRST + 10 * PERIOD))
    arrow = record("arrow", ARROW)

    nominal = best_linear(fitted)
    verdict = diagnose(
        nominal,
        (fitted,),
        validation=(held_out,),
        name="silverbox",
        transient=TRANSIENT,
        uncertain_nominal=True,
        units=Units(length="V", mass="s^2", time="s", force="V"),  # of a circuit
    )
    errors = {
        name: {"before": rmse(nominal, r, transient), "after": rmse(verdict.corrected, r, transient)}
        for name, r, transient in (("multisines", held_out, TRANSIENT), ("arrow", arrow, 0.0))
    }
    outcome.say(verdict.sentence)
    for name, error in errors.items():
        outcome.say(f"{name}: RMSE {1e3 * error['before']:.2f} mV → {1e3 * error['after']:.2f} mV")
    outcome.table("verdict", verdict.to_json())
    outcome.table("rmse", errors)
    outcome.check("held-out multisines: RMSE after, V", errors["multisines"]["after"], 0.5e-3)
    outcome.check("arrow: RMSE after, V", errors["arrow"]["after"], 0.8e-3)
    force = plot_unmodelled_force(verdict, length="V", force="V")
    outcome.figure("force", force, "Force beyond the linear model, against the motion.")
    outcome.figure("budget", plot_budget(verdict.budget), "What causes the gap of the linear model, held out.")
