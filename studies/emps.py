"""What does a servo drive lack whose model is a mass with viscous friction? Diagnosed as it was measured."""

from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scipy.signal import butter, filtfilt

from workbench.draw.gap import plot_budget, plot_responses, plot_unmodelled_force
from workbench.gap.diagnose import diagnose
from workbench.records.record import Channel, Record
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes, PointShapes

NEEDS_DATA = "the folder with DATA_EMPS.mat and DATA_EMPS_PULSES.mat of the EMPS benchmark"
# Janot, Gautier, Brunot, Data set and reference models of EMPS (2019)
PUBLISHED = {"mass": 95.11, "viscous": 203.5, "dry": 20.39, "offset": 3.16}  # kg, N s/m, N, N
RATE, KEPT = 1000.0, 10  # samples per second as measured; of which one in ten is kept, forces averaged between
QUIET_ABOVE_HZ, BELIEVED_BELOW_HZ = 100.0, 50.0  # of the position; of the forces that are compared
NOISE = 1e-3  # m/s and m: about a hundredth of the motion, which is as much as a model is asked to explain
EDGE = 200  # samples at either end that the filters spoil
AT_REST = 1e-3  # m/s: from the first instant so slow on, for a simulation begins at rest


def read(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Force of the drive (N), position (m) and velocity (m/s) of the carriage, from a first rest on: (n_samples,)."""
    file = loadmat(path)
    position = file["qm"].ravel()
    smooth = filtfilt(*butter(4, 2 * QUIET_ABOVE_HZ / RATE), position)
    force, velocity = file["gtau"].item() * file["vir"].ravel(), np.gradient(smooth, 1.0 / RATE)
    rest = EDGE + int(np.argmax(np.abs(velocity[EDGE:]) < AT_REST))
    return force[rest:], position[rest:], velocity[rest:]


def record_of(force: np.ndarray, motion: np.ndarray, quantity: str, name: str) -> Record:
    n = force.size // KEPT * KEPT
    return Record(
        sample_time=KEPT / RATE,
        outputs=motion[None, :n:KEPT],
        output_channels=(Channel("carriage", quantity),),
        inputs=force[:n].reshape(1, -1, KEPT).mean(axis=2),
        input_channels=(Channel("drive", "force"),),
        name=name,
    )


def nominal(quantity: str) -> Rig:
    """A mass on a rail with viscous friction: one rigid mode."""
    mass, viscous = PUBLISHED["mass"], PUBLISHED["viscous"]
    modes = Modes(
        omega=[0.0],
        damping=[[viscous / mass]],
        shapes=PointShapes(np.full((2, 1), 1.0 / np.sqrt(mass))),
        domain=NamedPoints(("drive", "carriage")),
    )
    return Rig(modes, (Actuator("drive", "drive"),), (Sensor("carriage", "carriage", quantity, noise_std=NOISE),))


def force_residual(signals, rig: Rig | None = None) -> float:
    """What a model leaves of the measured force, relative rms; without a rig, the best of mass and viscous friction."""
    force, _, velocity = signals
    filtered = butter(4, 2 * BELIEVED_BELOW_HZ / RATE)

    def shown(series: np.ndarray) -> np.ndarray:
        return filtfilt(*filtered, series)[EDGE:-EDGE]

    acceleration, measured = np.gradient(velocity, 1.0 / RATE), shown(force)
    if rig is None:
        motion = np.column_stack([shown(acceleration), shown(velocity)])
        left = measured - motion @ np.linalg.lstsq(motion, measured, rcond=None)[0]
    else:
        mass = float(rig.modes.phi_at("drive")[0] ** -2)
        viscous = mass * float(rig.modes.damping[0, 0])
        needed = mass * acceleration + viscous * velocity - rig.actuators[0].bias
        for friction in rig.elements:
            needed = needed + friction.force * np.tanh(velocity / friction.smoothing_speed) + friction.offset
        left = measured - shown(needed)
    return float(np.linalg.norm(left) / np.linalg.norm(measured))


def friction_of(rig: Rig) -> dict[str, float]:
    """Dry friction and constant force, N, of a corrected rig, however its effects share them."""
    dry = [element for element in rig.elements if hasattr(element, "smoothing_speed")]
    offset = rig.actuators[0].bias - sum(element.offset for element in dry)
    return {"dry": float(sum(element.force for element in dry)), "offset": float(offset)}


def study(outcome, data: Path) -> None:
    names = {"slow and fast strokes": "DATA_EMPS.mat", "with pulses of force": "DATA_EMPS_PULSES.mat"}
    signals = {name: read(Path(data) / file) for name, file in names.items()}
    verdicts, records = {}, {}
    for quantity in ("velocity", "displacement"):
        fitted, held_out = (
            record_of(force, velocity if quantity == "velocity" else position - position[0], quantity, name)
            for name, (force, position, velocity) in signals.items()
        )
        verdict = diagnose(nominal(quantity), (fitted,), validation=(held_out,), name="emps", uncertain_nominal=True)
        verdicts[quantity], records[quantity] = verdict, (fitted, held_out)
        outcome.say(f"{quantity} measured: {verdict.sentence}")
        outcome.table(f"verdict_{quantity}", verdict.to_json())
        outcome.table(f"friction_{quantity}", friction_of(verdict.corrected) | {"published": PUBLISHED})
    verdict = verdicts["velocity"]
    residuals = {
        name: {"viscous friction alone": force_residual(each), "corrected": force_residual(each, verdict.corrected)}
        for name, each in signals.items()
    }
    outcome.table("force_residual", residuals)
    for name, each in residuals.items():
        shares = ", ".join(f"{100 * share:.1f} % with {what}" for what, share in each.items())
        outcome.say(f"force that no model explains, {name}: {shares}")
    found = friction_of(verdict.corrected)
    outcome.check("dry friction found, beside 20 N: error", abs(found["dry"] / 20.0 - 1.0), 0.1)
    outcome.check("constant force found, beside the published one: error, N", abs(found["offset"] - 3.16), 1.0)
    outcome.check("residual of the force on the record fitted", residuals["slow and fast strokes"]["corrected"], 0.046)
    outcome.check("residual of the force on the record held out", residuals["with pulses of force"]["corrected"], 0.06)
    kinds = {effect.kind.name for each in verdicts.values() for effect in each.effects if not effect.kind.first}
    friction_alone = kinds <= {"coulomb_friction", "two_way_friction", "actuator_bias"}
    outcome.check("effects named that are neither friction nor a constant force", int(not friction_alone), 0)
    outcome.figure("force", plot_unmodelled_force(verdict), "Force beyond mass and viscous friction.")
    outcome.figure("budget", plot_budget(verdict.budget), "What causes the gap of the model, on the record held out.")
    rigs = {"mass and viscous friction": verdict.nominal, "corrected": verdict.corrected}
    both = records["velocity"]
    outcome.figure("response", plot_responses(rigs, both), "Velocity of the carriage, measured and simulated.")
