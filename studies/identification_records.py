"""How near the bound are the modes, whatever the record: several together, one sensor, driven, unknown forces?

Random cantilevers are measured in every way there is, each record 40 dB above its noise. Errors are given in standard
errors of the Cramér-Rao bound, taken from finite differences of the true response; below it no method can be. With
--data, a folder of ring-downs of a measured arm (arm-ringdown) is read as it came.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.lines import Line2D
from scipy.integrate import solve_ivp
from scipy.optimize import linear_sum_assignment
from scipy.signal import lfilter
from scipy.stats import norm

from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.identification.ambient import identify_ambient
from workbench.identification.driven import identify_driven
from workbench.identification.free_decay.assumptions import amplitude_dependence
from workbench.identification.free_decay.order import identify
from workbench.identification.frf import identify_frf
from workbench.identification.ring_down import ring_down
from workbench.records.record import Channel, Record
from workbench.structure.member import Beam

FIRST_SEED, DRAWS = 7000, 30
N, DT, LEVEL = 1000, 0.005, 0.01
MODES, SENSORS, HELD = 3, 3, 300
ACCELERATIONS = ("acceleration",) * SENSORS
LEAST_ANSWER, SAME = 0.2, 0.02
DERIVATIVE = {"displacement": 0, "velocity": 1, "acceleration": 2}
TAIL = 0.9  # y_k = 0.9 y_k-1 + e_k: noise that is not white
LINES = np.arange(1.0, 70.0, 0.25)
SEEN_ON_THE_ARM = (2.5, 18.0, 53.0, 107.0, 178.5)


class Structure:
    """A cantilever of random damping, measured at random places, excited where each mode responds."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = np.random.default_rng(seed)
        self.zeta = rng.uniform(0.01, 0.02, MODES)
        beam = Beam(length=1.0, mass_per_length=1.0, bending_stiffness=25.0, left="clamped", right="free").modes(MODES)
        self.omega = beam.omega
        self.poles = self.omega * (-self.zeta + 1j * np.sqrt(1.0 - self.zeta**2))
        self.seen = beam.phi(np.sort(rng.uniform(0.3, 1.0, SENSORS)))
        places = beam.phi(np.linspace(0.3, 1.0, 71))
        self.excited = rng.choice(places[np.abs(places).min(axis=1) > LEAST_ANSWER * np.abs(places).max()])

    def amplitudes(self, quantities) -> np.ndarray:
        """Of y = Re Σ a z, z' = λ z + u, for each sensor's quantity, (n_outputs, n_modes)."""
        order = np.array([DERIVATIVE[quantity] for quantity in quantities])[:, None]
        return -1j * self.seen[: len(order)] * self.excited / self.poles.imag * self.poles**order

    def figures(self) -> np.ndarray:
        return np.r_[self.omega, self.zeta]


def channels(quantities) -> tuple[Channel, ...]:
    return tuple(Channel(f"y{j}", quantity) for j, quantity in enumerate(quantities))


def poles_of(figures: np.ndarray) -> np.ndarray:
    omega, zeta = np.split(figures, 2)
    return omega * (-zeta + 1j * np.sqrt(1.0 - zeta**2))


def bound(answer: Callable[[np.ndarray], np.ndarray], truth: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Covariance (2 n_modes, 2 n_modes) of ω and ζ that no unbiased estimate can have less of.

    Args:
        answer: parameters -> (n_outputs, n_samples) real, what would be measured without noise.
        truth: parameters, ω and ζ first.
        std: (n_outputs, 1) of white noise.
    """
    steps = 1e-6 * np.maximum(np.abs(truth), 1e-3 * np.abs(truth).max())
    slopes = [
        ((answer(truth + step) - answer(truth - step)) / (2.0 * step.max() * std)).ravel() for step in np.diag(steps)
    ]
    j = np.array(slopes).T
    scale = 1.0 / np.linalg.norm(j, axis=0)
    return (np.linalg.inv((j * scale).T @ (j * scale)) * np.outer(scale, scale))[: 2 * MODES, : 2 * MODES]


def parts(parameters: np.ndarray, n_outputs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poles, complex amplitudes and what is left of a parameter vector."""
    n = n_outputs * MODES
    a, rest = parameters[2 * MODES : 2 * MODES + 2 * n], parameters[2 * MODES + 2 * n :]
    return poles_of(parameters[: 2 * MODES]), (a[:n] + 1j * a[n:]).reshape(n_outputs, MODES), rest


def packed(structure: Structure, a: np.ndarray, *rest: np.ndarray) -> np.ndarray:
    return np.concatenate([structure.figures(), a.real.ravel(), a.imag.ravel(), *rest])


def free_decay(structure: Structure, quantities=ACCELERATIONS, *, tail: float = 0.0, start=1.0):
    """A ring-down in noise, from modal states `start`, and its bound."""
    a, time = structure.amplitudes(quantities) * start, DT * np.arange(N)

    def answer(parameters):
        poles, a, offset = parts(parameters, len(quantities))
        clean = (a @ np.exp(np.outer(poles, time))).real + offset[:, None]
        # Noise of a known tail is white behind the filter that undoes it.
        return lfilter([1.0, -tail], [1.0], clean, axis=1)[:, 1:] if tail else clean

    clean = (a @ np.exp(np.outer(structure.poles, time))).real
    std = LEVEL * np.sqrt((clean**2).mean(axis=1, keepdims=True))
    noise = structure.rng.standard_normal((len(quantities), N + 200))
    noise = lfilter([np.sqrt(1.0 - tail**2)], [1.0, -tail], noise, axis=1)[:, 200:]
    truth = packed(structure, a, np.zeros(len(quantities)))
    return Record(DT, clean + std * noise, channels(quantities)), bound(answer, truth, std * np.sqrt(1.0 - tail**2))


def one(structure: Structure, *options, **more):
    record, least = free_decay(structure, *options, **more)
    return identify(record).refined, least


def together(structure: Structure):
    """Three impulses, identified together."""
    every = [free_decay(structure) for _ in range(3)]
    least = np.linalg.inv(sum(np.linalg.inv(least) for _, least in every))
    return identify([record for record, _ in every]).refined, least


def held_before(structure: Structure):
    """A hand sways the beam, and lets go at an unknown time."""
    force = np.zeros(HELD + 1)
    force[:HELD] = lfilter([0.15], [1.0, -0.85], structure.rng.standard_normal(HELD))
    z = modal_response(structure.poles, force)
    record, least = free_decay(structure, start=z[:, -1])
    swayed = (structure.amplitudes(ACCELERATIONS) @ z).real + np.outer(structure.seen @ structure.excited, force)
    swayed = swayed[:, :HELD]
    quiet = LEVEL * record.outputs.std(axis=1, keepdims=True) * structure.rng.standard_normal(swayed.shape)
    decay = ring_down(replace(record, outputs=np.hstack([swayed + quiet, record.outputs])))
    late = (decay.records[0].start_time - HELD * DT) * structure.omega[-1] / (2.0 * np.pi)
    return decay.refined, least, late


def known_force(structure: Structure):
    """A force that is noise, held over each sample; the state at the first sample is unknown."""
    a = structure.amplitudes(ACCELERATIONS)
    direct, u = structure.seen @ structure.excited, structure.rng.standard_normal(N)
    time = DT * np.arange(N)

    def answer(parameters):
        poles, a, rest = parts(parameters, SENSORS)
        direct, offset, start = rest[:SENSORS], rest[SENSORS : 2 * SENSORS], rest[2 * SENSORS :]
        z = modal_response(poles, u) + (start[:MODES] + 1j * start[MODES:])[:, None] * np.exp(np.outer(poles, time))
        return (a @ z).real + direct[:, None] * u + offset[:, None]

    truth = packed(structure, a, direct, np.zeros(SENSORS + 2 * MODES))
    clean = answer(truth)
    std = LEVEL * np.sqrt((clean**2).mean(axis=1, keepdims=True))
    outputs = clean + std * structure.rng.standard_normal(clean.shape)
    record = Record(DT, outputs, channels(ACCELERATIONS), u[None], (Channel("shaker", "force"),))
    return identify_driven(record), bound(answer, truth, std)


def modal_response(poles: np.ndarray, u: np.ndarray) -> np.ndarray:
    """z' = λ z + u from rest, u held over each sample, (n_modes, n_samples)."""
    steps = np.exp(poles * DT)
    return np.array([lfilter([0.0, (m - 1.0) / p], [1.0, -m], u.astype(complex)) for p, m in zip(poles, steps)])


def transfer_functions(structure: Structure):
    """Accelerances at lines a quarter of a hertz apart, with noise of known size."""
    a, s = 0.5 * structure.amplitudes(ACCELERATIONS), 2j * np.pi * LINES

    def answer(parameters):
        poles, a, rest = parts(parameters, SENSORS)
        above, below = rest[:SENSORS, None], rest[SENSORS:, None]
        h = sum(np.outer(c, 1.0 / (s - p)) + np.outer(c.conj(), 1.0 / (s - p.conj())) for c, p in zip(a.T, poles))
        h = h + above * s**2 / np.abs(s[-1]) ** 2 + below
        return np.hstack([h.real, h.imag])

    truth = packed(structure, a, np.zeros(SENSORS), structure.seen @ structure.excited)
    clean = answer(truth)
    std = LEVEL * np.sqrt((clean**2).mean(axis=1, keepdims=True))
    real, imaginary = np.split(clean + std * structure.rng.standard_normal(clean.shape), 2, axis=1)
    noise = np.broadcast_to(std, real.shape)
    found = identify_frf(real + 1j * imaginary, LINES, channels=channels(ACCELERATIONS), noise_std=noise)
    return found, bound(answer, truth, std)


def unknown_forces(structure: Structure):
    """Wind at three places, none of it measured, over four minutes."""
    n = 48_000
    outputs = np.zeros((SENSORS, n))
    for _ in range(3):
        push, force = structure.rng.standard_normal(MODES), structure.rng.standard_normal(n)
        a, direct = structure.amplitudes(ACCELERATIONS) * push, structure.seen @ (structure.excited * push)
        outputs += (a @ modal_response(structure.poles, force)).real + direct[:, None] * force
    outputs += LEVEL * outputs.std() * structure.rng.standard_normal(outputs.shape)
    found = identify_ambient(Record(DT, outputs, channels(ACCELERATIONS)))
    return found, None


WAYS = {
    "one ring-down": one,
    "three ring-downs together": together,
    "held before, released at a time not given": held_before,
    "one sensor only": lambda structure: one(structure, ("acceleration",)),
    "displacement, velocity and acceleration": lambda structure: one(structure, tuple(DERIVATIVE)),
    "noise that is not white": lambda structure: one(structure, tail=TAIL),
    "known force": known_force,
    "transfer functions": transfer_functions,
    "unknown forces": unknown_forces,
}


def scored(structure: Structure, way: str) -> dict:
    """Errors of ω and ζ over the bound and over their own standard errors, of the modes that are there."""
    found, least, *late = WAYS[way](structure)
    apart = np.abs(found.modes.omega[:, None] / structure.omega - 1.0)
    r, s = linear_sum_assignment(apart)
    r, s = r[apart[r, s] < SAME], s[apart[r, s] < SAME]
    own = np.concatenate([found.omega_std[r], found.zeta_std[r]])
    errors = np.concatenate([(found.modes.omega[r] - structure.omega[s]), (found.modes.zeta[r] - structure.zeta[s])])
    bound = own if least is None else np.sqrt(np.diag(least))[np.r_[s, s + MODES]]
    counts = {"right": r.size, "identified": found.modes.n_modes, "late": late[0] if late else 0.0}
    return {**counts, "own": errors / own, "bound": errors / bound}


def records_errors(errors, summary):
    """Errors of every figure by the kind of record, beside those of a method that attains the bound.

    Args:
        errors: by kind (n_figures,), in standard errors of the bound.
        summary: by kind, with over_bound and inside, as `identification_records`.
    """
    figure, ax = new_figure(1, 1, width=10.5, height=5.4)
    rng, x = np.random.default_rng(0), np.linspace(-4.0, 4.0, 201)
    bell = 0.36 * np.exp(-0.5 * x**2)
    for row, (kind, apart) in enumerate(errors.items()):
        totals, spread = summary[kind], np.clip(apart, -4.0, 4.0)
        ax.fill_between(x, row - bell, row + bell, color=GREY, alpha=0.25, lw=0)
        at = row + rng.uniform(-0.3, 0.3, spread.size) * np.exp(-0.5 * spread**2)
        ax.plot(spread, at, "o", ms=3, color=COLOURS[0], alpha=0.6, mew=0)
        least = "bound" if totals["bound"] == "Cramér-Rao" else "estimated error"
        text = (
            f"rms error / {least} = {totals['over_bound']:.2f}\n{100 * totals['inside']:.0f} % in their 95 % intervals"
        )
        ax.text(4.15, row, text, va="center", fontsize=8.5)
    ax.set_yticks(range(len(errors)), list(errors))
    ax.set(ylim=(len(errors) - 0.5, -0.5), xlim=(-4.0, 6.2))
    ax.set_xticks(range(-4, 5, 2))
    ax.set_xlabel(
        "error of a frequency or damping ratio / standard error (Cramér-Rao bound; of unknown forces, estimated)"
    )
    handles = [
        Line2D([], [], marker="o", lw=0, color=COLOURS[0], ms=4, label="one estimate"),
        Line2D([], [], color=GREY, alpha=0.4, lw=8, label="what a method that attains the bound would show"),
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=2)
    return figure


def study(outcome, data: Path | None = None) -> None:
    plan = [(way, k) for way in WAYS for k in range(DRAWS)]
    rows: dict[str, list[dict]] = {way: [] for way in WAYS}
    for way, k in outcome.track(plan, "records"):
        rows[way].append(scored(Structure(FIRST_SEED + k), way))
    errors = {way: np.concatenate([row["bound"] for row in each]) for way, each in rows.items()}
    summary = {way: summed(way, rows[way]) for way in WAYS}
    outcome.table("records", summary)
    for way, totals in summary.items():
        outcome.check(f"{way}: precision", totals["precision"], 0.98, at_least=True)
        outcome.check(f"{way}: recall", totals["recall"], 0.98, at_least=True)
        if way == "unknown forces":
            continue
        outcome.check(f"{way}: rms error over the Cramér-Rao bound", totals["over_bound"], 1.1)
        outcome.check(f"{way}: coverage of 95 % intervals", totals["inside"], 0.92, at_least=True)
    unknown = summary["unknown forces"]
    outcome.say(
        f"under unknown forces {100 * unknown['recall']:.0f} % of the modes are found, and 95 % intervals hold the"
        f" truth in {100 * unknown['inside']:.0f} %"
    )
    worst = max(errors, key=lambda way: summary[way]["over_bound"] * (way != "unknown forces"))
    outcome.say(f"rms error over the Cramér-Rao bound: at most {summary[worst]['over_bound']:.3g} ({worst})")
    late = np.array([row["late"] for row in rows["held before, released at a time not given"]])
    outcome.table("start", {"late_in_shortest_periods": late})
    near = float((np.abs(late) < 1.0).mean())
    outcome.check("start of the decay: share found to the shortest period", near, 0.95, at_least=True)
    outcome.say(f"start of the decay found to the shortest period in {100 * near:.0f} % of the records")
    by_amplitude(outcome)
    if data is not None:
        arm(outcome, data)
    outcome.figure(
        "errors",
        records_errors(errors, summary),
        "Error of each frequency and damping ratio, in standard errors by the Cramér-Rao bound, by the kind of record."
        " Grey: what a perfect method would show.",
    )


def summed(way: str, rows: list[dict]) -> dict:
    apart, own = (np.concatenate([row[name] for row in rows]) for name in ("bound", "own"))
    right, identified = (sum(row[name] for row in rows) for name in ("right", "identified"))
    return {
        "records": len(rows),
        "precision": right / identified,
        "recall": right / (MODES * len(rows)),
        "bound": "none known: its own errors" if way == "unknown forces" else "Cramér-Rao",
        "over_bound": float(np.sqrt((apart**2).mean())),
        "inside": float((np.abs(own) < norm.ppf(0.975)).mean()),
    }


def by_amplitude(outcome) -> None:
    """A mass on a hardening spring beside linear ones: x'' + 2ζω x' + ω² x + κ x³ = 0, ω(A) = ω + 3κA²/8ω."""
    omega, zeta, kappa, time = 10.0, 0.004, 6.0, 0.02 * np.arange(3000)
    motion = solve_ivp(
        lambda t, y: [y[1], -2.0 * zeta * omega * y[1] - omega**2 * y[0] - kappa * y[0] ** 3],
        (0.0, time[-1]), [1.0, 0.0], t_eval=time, method="DOP853", rtol=1e-8, atol=1e-10,
    ).y[0]  # fmt: skip
    noise = 1e-3 * np.random.default_rng(FIRST_SEED).standard_normal(time.size)
    decay = ring_down(Record(0.02, (motion + noise)[None], (Channel("x", "displacement"),)), n_modes=1).by_amplitude
    backbone = omega + 3.0 * kappa * decay.amplitude[:, 0] ** 2 / (8.0 * omega)
    apart = np.nanmax(np.abs(decay.omega[:, 0] - backbone)) / np.nanmax(backbone - omega)
    outcome.table("backbone", {"amplitude": decay.amplitude[:, 0], "omega": decay.omega[:, 0], "exact": backbone})
    outcome.check("hardening spring: dependence on amplitude missed", 0 if decay.depends.all() else 1, 0)
    outcome.check("hardening spring: error of the backbone over its rise", apart, 0.1)
    alarms = 0
    for k in range(DRAWS):
        record, _ = free_decay(Structure(FIRST_SEED + k))
        alarms += int(amplitude_dependence(record, identify(record).refined).depends.any())
    outcome.check("linear structures said to depend on amplitude", alarms, 0)
    outcome.say(
        f"a backbone is read to {100 * apart:.2g} % of its rise; of {DRAWS} linear structures {alarms} seem to depend"
        " on amplitude"
    )


def arm(outcome, data: Path) -> None:
    """Modes of the measured arm that stand in its spectra."""
    table = np.loadtxt(data / "hold_and_release_1.txt")
    decay = ring_down(Record(0.002, table[:, -1][None], (Channel("a", "acceleration"),)))
    found = decay.modes.frequencies_hz
    apart = [float(np.abs(found / seen - 1.0).min()) for seen in SEEN_ON_THE_ARM]
    outcome.table("arm", {"start": decay.records[0].start_time, "frequencies_hz": found, "zeta": decay.modes.zeta})
    outcome.check("arm: frequencies picked by eye and the nearest identified, relative", max(apart), 0.02)
    outcome.say(f"the hand leaves the arm at {decay.records[0].start_time:.3f} s; modes at "
                + ", ".join(f"{f:.4g}" for f in found) + " Hz")  # fmt: skip
