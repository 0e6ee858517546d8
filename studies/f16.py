"""What makes the wing of an aircraft nonlinear? A ground vibration test of an F-16, learnt at some levels."""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scipy.optimize import least_squares

from workbench.draw.signals import plot_distortion
from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect, apply_all
from workbench.identification.frf import identify_frf
from workbench.identification.rig_from import rig_from
from workbench.identification.signal.distortion import distortion_of
from workbench.records.record import Channel, Record
from workbench.rig.force_laws import hysteresis
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate_record
from workbench.structure.domain import Between
from workbench.structure.modes import Modes, PointShapes

NEEDS_DATA = "the folder with level1.mat to level7.mat of the F-16 benchmark"
PUBLISHED = {"black-box state space": 0.146, "LSTM": 0.338, "two linear modes": 0.599}  # m/s², official records
LEARNT, HELD_OUT = (1, 3, 5, 7), (2, 4, 6)
SENSORS = ("excitation", "wing", "payload")
RATE, PERIOD, PERIODS = 400.0, 8192, 9  # Hz; samples
EXCITED_TO_HZ = 15.0
KEPT = 2  # of so many samples one is kept to learn from: 15 Hz are excited
BEYOND_HZ, BEYOND_ZETA = (1.0, 17.5, 30.0), 0.05  # modes that stand for those below and above, to start from
STEP, ROUNDS, TO_THE_END = 1e-4, 11, 30  # of a number over its size, for slopes; of a fit; of one of a single level
STIFFNESS, TRAVEL = np.geomspace(1e4, 1e7, 7), (1e-5, 3e-5, 1e-4)  # N/m and m: starts of a law between two points
REACH = (0.3, 3.0, 10.0, 10.0)  # of logarithms of frequencies and damping ratios, of shapes over their size, of laws
SUBSTEPS, RUNAWAY = 2, 1e6  # steps of a sample; m/s²


def read(data: Path, level: int) -> Record:
    """A whole record: nine periods."""
    file = loadmat(data / f"level{level}.mat")
    return _record(file["Force"], file["Acceleration"], 1.0 / RATE, level)


def mean_period(record: Record, level: int, kept: int = 1) -> Record:
    """The mean of all periods but the first, one sample in `kept` of it, twice: once to settle, once to count."""

    def mean(signals: np.ndarray) -> np.ndarray:
        lines = np.fft.rfft(signals.reshape(-1, PERIODS, PERIOD)[:, 1:].mean(axis=1), axis=1)
        n = PERIOD // kept
        return np.tile(np.fft.irfft(lines[:, : n // 2 + 1], n, axis=1) / kept, 2)

    return _record(mean(record.inputs), mean(record.outputs), kept / RATE, level)


def _record(force: np.ndarray, acceleration: np.ndarray, sample_time: float, level: int) -> Record:
    return Record(
        sample_time=sample_time,
        outputs=acceleration,
        output_channels=tuple(Channel(name, "acceleration") for name in SENSORS),
        inputs=force,
        input_channels=(Channel("excitation", "force"),),
        input_hold="first",  # a measured force
        name=f"level {level}",
    )


def identified(record: Record) -> Rig:
    """The rig of the modes that the response functions of a record show, and three that stand for those beyond."""
    force, outputs = (np.fft.rfft(s.reshape(-1, PERIODS, PERIOD)[:, 1:]) for s in (record.inputs, record.outputs))
    strength = np.abs(force[0]).mean(axis=0)
    lines = np.flatnonzero(strength > 0.05 * strength.max())
    transfer = (outputs / force)[:, :, lines].mean(axis=1)
    # what is left is no noise but distortion, at this level too: its size is left to the identification to find
    found = identify_frf(transfer, lines * RATE / PERIOD, channels=record.output_channels)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # complex modes, which the fit that follows makes real
        rig = rig_from(found, inputs=["excitation"], outputs=record.output_channels)
    modes = rig.modes
    beyond = 2.0 * np.pi * np.array(BEYOND_HZ)
    omega, shapes = np.r_[modes.omega, beyond], modes.phi(SENSORS)
    shapes = np.c_[shapes, np.tile(0.1 * np.abs(shapes).mean(), (len(SENSORS), len(beyond)))]
    zeta = np.r_[modes.zeta, [BEYOND_ZETA] * len(beyond)]
    return replace(rig, modes=Modes(omega=omega, damping=zeta, shapes=PointShapes(shapes), domain=modes.domain))


def left(rig: Rig, record: Record) -> np.ndarray:
    """Measured less simulated over the period that counts, (n_sensors, n_samples); large where the motion runs away."""
    counted = slice(record.n_samples // 2, None)
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            error = record.outputs - simulate_record(rig, record, substeps=SUBSTEPS)
    except ValueError:
        return np.full(record.outputs[:, counted].shape, RUNAWAY)
    return np.clip(error[:, counted], -RUNAWAY, RUNAWAY)


def rms_of(rig: Rig, record: Record) -> np.ndarray:
    """Rms error of each sensor (n_sensors,), m/s²."""
    return np.sqrt((left(rig, record) ** 2).mean(axis=1))


def beyond_excitation(error: np.ndarray) -> np.ndarray:
    """Rms of each row of errors (n_sensors, n_samples) at frequencies that are not excited, m/s²: the joint rattles."""
    lines = np.fft.rfft(error)
    lines[:, : int(EXCITED_TO_HZ * PERIOD / RATE) + 1] = 0.0
    return np.fft.irfft(lines, error.shape[1]).std(axis=1)


def fitted(
    rig: Rig, records: Sequence[Record], effects: Sequence[Effect] = (), rounds: int = ROUNDS
) -> tuple[Rig, tuple[Effect, ...]]:
    """The rig and effects whose frequencies, damping, shapes and numbers leave least of the records.

    Each record weighs by the root of its level: the high ones say more, and must not say all.
    """
    shapes, n = rig.modes.phi(SENSORS), rig.modes.n_modes
    size = np.sqrt((shapes**2).mean())
    numbers = [(i, p) for i, effect in enumerate(effects) for p in effect.parameters(rig)]
    free = [p.to_free(effects[i].values[p.name]) for i, p in numbers]
    start = np.r_[np.log(rig.modes.omega), np.log(rig.modes.zeta), shapes.ravel() / size, free]
    weights = [np.sqrt(record.outputs.std()) for record in records]

    def made(theta: np.ndarray) -> tuple[Rig, tuple[Effect, ...]]:
        x = start + theta - 1.0
        modes = Modes(
            omega=np.exp(x[:n]),
            damping=np.exp(x[n : 2 * n]),
            shapes=PointShapes(size * x[2 * n : 5 * n].reshape(3, n)),
            domain=rig.modes.domain,
        )
        values = [dict(effect.values) for effect in effects]
        for (i, p), z in zip(numbers, x[5 * n :], strict=True):
            values[i][p.name] = p.from_free(z)
        return replace(rig, modes=modes), tuple(replace(e, values=v) for e, v in zip(effects, values, strict=True))

    def residual(theta: np.ndarray) -> np.ndarray:
        real = apply_all(*made(theta))
        return np.concatenate([left(real, record).ravel() / w for record, w in zip(records, weights, strict=True)])

    reach = np.repeat([*REACH], [n, n, 3 * n, len(free)])
    bounds = (1.0 - reach, 1.0 + reach)
    how = {"diff_step": STEP, "x_scale": "jac", "ftol": 1e-3, "max_nfev": rounds, "bounds": bounds}
    return made(least_squares(residual, np.ones(start.size), **how).x)


def started(kind: str, where: Between, rig: Rig, records: Sequence[Record]) -> Effect:
    """A law between two points with the numbers, of a few, that leave least of the records."""
    names = [p.name for p in kind_named(kind).parameters(rig, None)]
    tried = [
        Effect(kind_named(kind), None, {"at": where, **dict(zip(names, numbers, strict=True))})
        for numbers in ((k, z) for k in STIFFNESS for z in TRAVEL)
    ]

    def cost(effect: Effect) -> float:
        real = effect.apply(rig)
        return float(sum((rms_of(real, r) ** 2 / r.outputs.var(axis=1)).sum() for r in records))

    return min(tried, key=cost)


def by_itself(law: Effect, low: Rig, raw: dict[int, Record]) -> dict[str, float]:
    """What modes and a law of that kind leave of a held-out level when they are fitted to that level, m/s².

    Mean of the sensors: about the least that modes and such a law can leave, learnt from whatever levels.
    """
    rms = {}
    for level in HELD_OUT:
        learnt = mean_period(raw[level], level, KEPT)
        rig, effects = fitted(low, [learnt], (started(law.kind.name, law.at, low, [learnt]),), TO_THE_END)
        rms[str(level)] = float(np.mean(rms_of(apply_all(rig, effects), mean_period(raw[level], level))))
    return rms


def with_any_force(rig: Rig, where: Between, record: Record) -> np.ndarray:
    """Rms error (n_sensors,), m/s², if a force of any time course acts between two points beside the excitation.

    Each line of that force is fitted to the lines of all sensors: no law between the two points leaves less with
    these modes.
    """
    measured, excitation = (np.fft.rfft(s[:, record.n_samples // 2 :]) for s in (record.outputs, record.inputs))
    omega = 2.0 * np.pi * np.fft.rfftfreq(record.n_samples // 2, record.sample_time)[:, None]
    modes = rig.modes
    modal = -(omega**2) / (modes.omega**2 - omega**2 + 2j * modes.zeta * modes.omega * omega)
    shapes = modes.phi(SENSORS)
    ends = modes.phi((where.first, where.second))
    error = measured - np.einsum("sm,fm,m->sf", shapes, modal, shapes[0]) * excitation
    response = np.einsum("sm,fm,m->sf", shapes, modal, ends[1] - ends[0])[:, 1:]  # at 0 Hz nothing moves
    force = (response.conj() * error[:, 1:]).sum(axis=0) / (np.abs(response) ** 2).sum(axis=0)
    error[:, 1:] -= response * force
    return np.sqrt((np.fft.irfft(error, record.n_samples // 2) ** 2).mean(axis=1))


def lost_stiffness(rig: Rig, slip: Effect, record: Record) -> float:
    """Share of its stiffness that a slipping joint loses at the level of a record: 1 - rms z / rms w."""
    ends = tuple(Sensor(name, name, "displacement") for name in (slip.at.first, slip.at.second))
    w = np.subtract(*simulate_record(replace(slip.apply(rig), sensors=ends), record))
    z = hysteresis(np.r_[0.0, w], slip.values["yield_displacement"])[1:]
    count = slice(record.n_samples // 2, None)
    return float(1.0 - z[count].std() / w[count].std())


def study(outcome, data: Path) -> None:
    raw = {level: read(Path(data), level) for level in (*LEARNT, *HELD_OUT)}
    learnt = [mean_period(raw[level], level, KEPT) for level in LEARNT]
    kept_out = {level: mean_period(raw[level], level) for level in HELD_OUT}
    distortions = [distortion_of(raw[level]) for level in (LEARNT[0], LEARNT[-1])]
    for found in distortions:
        rms = found.rms
        beside = np.hypot(rms["odd"], rms["even"]) / rms["excited"]
        outcome.say(
            f"{found.name}: on lines that are not excited {100 * beside.max():.0f} % of those that are, at most"
        )
    outcome.figure("distortion", plot_distortion(distortions), "Before any model: lines excited, lines not, and noise.")

    low, _ = fitted(identified(raw[1]), learnt[:1])
    linear, _ = fitted(low, learnt)
    pairs = [Between(one, other) for one, other in (SENSORS[1:], SENSORS[:2])]
    tried = [("joint_slip", pair) for pair in pairs]
    models: dict[str, Rig] = {"level 1 alone": low, "best linear": linear}
    laws: dict[str, Effect] = {}
    for kind, pair in outcome.track(tried, "laws"):
        rig, effects = fitted(low, learnt, (started(kind, pair, low, learnt[1::2]),))
        name = f"{effects[0].kind.words} between {pair.first} and {pair.second}"
        models[name], laws[name] = apply_all(rig, effects), effects[0]
        models[f"{name}, without it"] = rig
    fit = {name: float(np.mean([rms_of(rig, r) for r in learnt])) for name, rig in models.items()}
    best = min(laws, key=lambda name: fit[name])
    errors = {
        name: {level: rms_of(models[name], record) for level, record in kept_out.items()}
        for name in ("level 1 alone", "best linear", best)
    }
    mean = {name: float(np.mean(list(each.values()))) for name, each in errors.items()}
    beyond = {
        name: float(np.mean([beyond_excitation(left(models[name], record)) for record in kept_out.values()]))
        for name in errors
    }
    outcome.table("fitted", {name: fit[name] for name in ("level 1 alone", "best linear", *laws)})
    outcome.table("held_out", {name: {str(k): list(map(float, v)) for k, v in e.items()} for name, e in errors.items()})
    outcome.table("mean above the excited band", beyond)
    law, without = laws[best], models[f"{best}, without it"]
    itself = by_itself(law, low, raw)
    outcome.table("fitted to each held-out level by itself", itself)
    any_force = float(np.mean([with_any_force(without, law.at, record) for record in kept_out.values()]))
    outcome.table("a force of any time course between the same points", any_force)
    outcome.table("mean", mean | {f"published: {name}": value for name, value in PUBLISHED.items()})
    outcome.table("law", {name: value for name, value in law.numbers.items()})
    if law.kind.name == "joint_slip":
        lost = {record.name: lost_stiffness(without, law, record) for record in (learnt[0], learnt[-1])}
        outcome.table("lost_stiffness", lost)
        numbers = f"{law.values['stiffness']:.3g} N/m, {1e6 * law.values['yield_displacement']:.0f} µm"
        shares = " and ".join(f"{100 * share:.0f} % at {name}" for name, share in lost.items())
        outcome.say(f"{best} ({numbers}) loses {shares} of its stiffness")
    for name, value in mean.items():
        outcome.say(
            f"{name}: {value:.3f} m/s² on levels 2, 4 and 6, mean of rms errors;"
            f" {beyond[name]:.3f} above {EXCITED_TO_HZ:.0f} Hz, where nothing is excited and the joint rattles"
        )
    least = float(np.mean(list(itself.values())))
    outcome.say(
        f"modes and such a law fitted to each of levels 2, 4 and 6 by itself: {least:.3f} m/s²,"
        f" {least / mean['best linear']:.2f} of the best linear model's error; the rest is beyond them"
    )
    outcome.say(
        f"a force of any time course between {law.at.first} and {law.at.second}, fitted to the sensors themselves,"
        f" would leave {any_force:.3f} m/s², {any_force / mean['best linear']:.2f} of the best linear model's error:"
        " no law there can leave less with these modes"
    )
    outcome.check("rms error, mean of held-out levels and sensors, m/s²", mean[best], 0.25)
    outcome.check("the same over that of the best linear model", mean[best] / mean["best linear"], 0.8)
    outcome.check("laws between other points that leave as little", sum(fit[n] <= fit[best] for n in laws) - 1, 0)
    outcome.check("that law stands between wing and payload", int(law.at == pairs[0]), 1, at_least=True)
    outcome.figure("errors", _plot_errors(errors), "Rms errors on levels that no fit has seen.")


def _plot_errors(errors):
    figure, axes = new_figure(1, len(SENSORS), width=10, height=3.6, sharey=True)
    colours = (GREY, COLOURS[1], COLOURS[0])
    for j, (ax, name) in enumerate(zip(axes, SENSORS, strict=True)):
        for shift, colour, (model, by_level) in zip((-0.25, 0.0, 0.25), colours, errors.items(), strict=True):
            at = np.arange(len(HELD_OUT)) + shift
            ax.bar(at, [by_level[level][j] for level in HELD_OUT], 0.22, color=colour, label=model)
        ax.set(title=name, xticks=range(len(HELD_OUT)), xticklabels=[f"level {level}" for level in HELD_OUT])
    axes[0].set(ylabel="rms error [m/s²]")
    axes[0].legend(fontsize=8)
    return figure
