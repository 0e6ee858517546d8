"""Is a local loss of stiffness detected and located from noisy sensors, when neither mass nor stiffness is known?

Bars and beams of random smooth mass and stiffness, solved by scikit-fem, lose a fifth of their stiffness over a tenth
of their length at a random place, or nothing. Twelve accelerometers record the ring-down after a random blow: six
modes, 40 dB above the noise. Known are the ends and the mass at one place; the nominal structure is uniform.
"""

from pathlib import Path

import numpy as np
import skfem
from scipy.sparse.linalg import eigsh
from skfem.helpers import dd, ddot, dot, grad

from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.identification.free_decay.order import identify
from workbench.identification.signal.synthesis import free_decay
from workbench.identification.updating.local_loss import LocatedDamage, locate_damage
from workbench.structure.member import Bar, Beam
from workbench.structure.modes import SampledModes

# The method was developed on seeds below 1000.
FIRST_SEED, CASES, FEWER = 5000, 25, 5
SHARE, WIDTH, LEVEL_DB, MODES = 0.2, 0.1, 40.0, 6
LOWER_LEVELS = (20.0, 0.0)
CHECKED = np.linspace(0.02, 0.98, 49)  # where the band of the stiffness is compared with the truth
WITHIN = 0.05
SENSORS = (np.arange(12) + 0.5) / 12
KNOWN_AT = 0.5
ENDS = {
    "beam": (("clamped", "free"), ("hinged", "hinged"), ("clamped", "hinged"), ("free", "free")),
    "bar": (("fixed", "free"), ("fixed", "fixed")),
}


class Hidden:
    """A structure that nobody knows: random smooth mass and stiffness, and a loss of `share` somewhere."""

    def __init__(self, kind: str, seed: int, share: float) -> None:
        self.rng = rng = np.random.default_rng([seed, kind == "bar"])
        self.kind, self.seed, self.share = kind, seed, share
        self.left, self.right = ENDS[kind][int(rng.integers(len(ENDS[kind])))]
        self.waves = rng.uniform(-0.1, 0.1, (2, 3))
        self.centre = rng.uniform(0.5 * WIDTH, 1.0 - 0.5 * WIDTH)
        self.blow = rng.uniform(0.03, 0.97)
        self.zeta = rng.uniform(0.005, 0.01, MODES)

    def mass(self, x):
        return self._smooth(0, x)

    def smooth_stiffness(self, x):
        return self._smooth(1, x)

    def stiffness(self, x):
        lost = np.abs(np.asarray(x) - self.centre) < 0.5 * WIDTH
        return self._smooth(1, x) * np.where(lost, 1.0 - self.share, 1.0)

    def _smooth(self, row: int, x):
        a, b, c = self.waves[row]
        return 1.0 + a * np.sin(np.pi * x) + b * np.cos(np.pi * x) + c * np.sin(2.0 * np.pi * x)

    def solve(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Frequencies of the six lowest elastic modes, their shapes at the sensors, and at the blow."""
        places = np.unique([0.0, 1.0, *SENSORS, self.blow, self.centre - 0.5 * WIDTH, self.centre + 0.5 * WIDTH])
        between = np.linspace(0.0, 1.0, 241)
        x = np.sort(np.r_[places, between[np.abs(between[:, None] - places).min(axis=1) > 1e-3]])
        beam = self.kind == "beam"
        element = skfem.ElementLineHermite() if beam else skfem.ElementLineP2()
        basis = skfem.Basis(skfem.MeshLine(x), element, intorder=8)
        stiff = skfem.BilinearForm(
            lambda u, v, w: self.stiffness(w.x[0]) * (ddot(dd(u), dd(v)) if beam else dot(grad(u), grad(v)))
        ).assemble(basis)
        heavy = skfem.BilinearForm(lambda u, v, w: self.mass(w.x[0]) * u * v).assemble(basis)
        held = []
        for node, end in ((0, self.left), (-1, self.right)):
            held += list(basis.nodal_dofs[: {"free": 0, "clamped": 2}.get(end, 1), node])
        free = np.setdiff1d(np.arange(basis.N), held)
        rigid = 2 * (self.left == self.right == "free")
        values, vectors = eigsh(
            stiff.tocsc()[np.ix_(free, free)], rigid + MODES, heavy.tocsc()[np.ix_(free, free)], sigma=-1.0
        )
        order = np.argsort(values)[rigid:]
        shapes = np.zeros((basis.N, MODES))
        shapes[free] = vectors[:, order]
        shapes = shapes[basis.nodal_dofs[0]]
        return np.sqrt(values[order]), shapes[np.searchsorted(x, SENSORS)], shapes[np.searchsorted(x, self.blow)]

    def record(self, level_db: float):
        """Accelerations after the blow, white noise `level_db` below them."""
        omega, shapes, at_blow = self.solve()
        omega_d = omega * np.sqrt(1.0 - self.zeta**2)
        decay = SampledModes(omega, self.zeta, -1j * shapes * at_blow / omega_d, SENSORS)
        window = {"sample_time": 0.8 * np.pi / omega[-1], "n_samples": 4000, "quantity": "acceleration"}
        size = float(np.sqrt((free_decay(decay, **window).outputs ** 2).mean()))
        return free_decay(decay, noise_std=size * 10 ** (-level_db / 20), seed=self.rng, **window)

    def nominal(self) -> Bar | Beam:
        """What is known of it: the ends."""
        where = {"length": 1.0, "mass_per_length": 1.0, "left": self.left, "right": self.right}
        return Beam(bending_stiffness=1.0, **where) if self.kind == "beam" else Bar(axial_stiffness=1.0, **where)


def tried(kind: str, seed: int, share: float = SHARE, level_db: float = LEVEL_DB):
    """The hidden structure and what was found of it."""
    hidden = Hidden(kind, seed, share)
    measured = identify(hidden.record(level_db)).refined
    return hidden, locate_damage(measured, hidden.nominal(), known_mass=[(KNOWN_AT, float(hidden.mass(KNOWN_AT)))])


def row(hidden: Hidden, found: LocatedDamage, level_db: float) -> dict:
    """What was found beside what is there."""
    x = CHECKED[np.abs(np.abs(CHECKED - hidden.centre) - 0.5 * WIDTH) > 0.01]
    low, high = found.best.stiffness.band(x)
    loss, truth = found.damaged.loss, np.array([hidden.share, hidden.centre, WIDTH])
    limits = found.interval()
    return {
        "kind": hidden.kind,
        "ends": f"{hidden.left}-{hidden.right}",
        "seed": hidden.seed,
        "level_db": level_db,
        "found": found.detected,
        "evidence": found.statistic,
        "explains": found.best.explains,
        "centre": hidden.centre,
        "error": abs(loss.centre - hidden.centre),
        "share": loss.share,
        "width": loss.width,
        "standard_error": float(np.sqrt(found.damaged.covariance[-2, -2])),
        "inside": ((limits[:, 0] <= truth) & (truth <= limits[:, 1])).tolist(),
        "terms": found.best.n_terms,
        "stiffness_inside": float(((low <= hidden.stiffness(x)) & (hidden.stiffness(x) <= high)).mean()),
        "stiffness_error": float(np.abs(found.best.stiffness(x) / hidden.stiffness(x) - 1.0).max()),
    }


def stiffness_found(cases):
    """Stiffness along each structure; cases[title] are (what was found, the true stiffness, places of the sensors)."""
    rows = (len(cases) + 1) // 2
    figure, axes = new_figure(rows, 2, width=10.0, height=0.6 + 2.9 * rows, sharex=True, sharey=True, squeeze=False)
    highest = 0.0
    for ax, (title, (found, truth, sensors)) in zip(axes.ravel(), cases.items()):
        length = found.best.structure.length
        x = np.linspace(0.0, length, 801)
        low, high = found.best.stiffness.band(x)
        ax.plot(x, truth(x), color=GREY, lw=4, alpha=0.6, label="true")
        ax.fill_between(x, low, high, color=COLOURS[0], alpha=0.25, lw=0, label="95 % band")
        ax.plot(x, found.best.stiffness(x), color=COLOURS[0], label="identified")
        ax.plot(sensors, np.zeros(sensors.size), "^", color=COLOURS[1], ms=8, clip_on=False, label="sensors")
        ax.set_title(title)
        highest = max(highest, high.max(), truth(x).max())
    axes[0, 0].set_ylim(0.0, 1.05 * highest)
    for ax in axes[-1]:
        ax.set_xlabel("x / length")
    for ax in axes[:, 0]:
        ax.set_ylabel("stiffness / nominal")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=4)
    return figure


def places_found(rows, *, within):
    """Error of the place of each loss over its true place, a colour a level of noise; crosses were not reported."""
    figure, ax = new_figure(width=8.5, height=4.4)
    levels = sorted({row["level_db"] for row in rows}, reverse=True)
    for level, colour in zip(levels, COLOURS, strict=False):
        here = [row for row in rows if row["level_db"] == level]
        for kind, marker in (("beam", "o"), ("bar", "s")):
            own = [row for row in here if row["kind"] == kind and row["found"]]
            places, errors = [row["centre"] for row in own], [max(row["error"], 1e-6) for row in own]
            ax.semilogy(places, errors, marker, color=colour, ms=5.5, mfc="none", label=f"{kind}, {level:g} dB")
        missed = [row for row in here if not row["found"]]
        ax.semilogy([row["centre"] for row in missed], [row["error"] for row in missed], "x", color=colour)
    ax.axhline(within, color=GREY, ls="--")
    ax.text(0.01, within * 1.15, f"{100 * within:g} % of the length", color=GREY, va="bottom")
    ax.set(xlim=(0.0, 1.0), ylim=(1e-6, 1.0))
    ax.set(xlabel="where the stiffness is lost, x / length", ylabel="error of the place / length")
    figure.legend(loc="outside upper right", ncols=len(levels))
    return figure


def study(outcome, data: Path | None = None) -> None:
    seeds = range(FIRST_SEED, FIRST_SEED + CASES)
    plan = [(kind, seed, SHARE, LEVEL_DB) for seed in seeds for kind in ENDS]
    plan += [(kind, seed, 0.0, LEVEL_DB) for seed in seeds for kind in ENDS]
    plan += [(kind, seed, SHARE, level) for level in LOWER_LEVELS for seed in seeds[:FEWER] for kind in ENDS]
    tries = {case: tried(*case) for case in outcome.track(plan, "structures")}
    rows = [row(*what, level_db=case[-1]) for case, what in tries.items()]
    damaged = [r for r, case in zip(rows, plan, strict=True) if case[2] > 0]
    undamaged = [r for r, case in zip(rows, plan, strict=True) if case[2] == 0]
    outcome.table("damaged", damaged)
    outcome.table(
        "undamaged", [{name: r[name] for name in ("kind", "ends", "seed", "found", "evidence")} for r in undamaged]
    )
    for kind in ENDS:
        summary(outcome, kind, [r for r in damaged if r["kind"] == kind])
    alarms = sum(r["found"] for r in undamaged)
    outcome.check("false alarms: share of undamaged structures reported as damaged", alarms / len(undamaged), 0.05)
    outcome.say(f"{alarms} of {len(undamaged)} undamaged structures are reported as damaged.")
    at_level = [r for r in damaged if r["level_db"] == LEVEL_DB]
    inside = np.mean([[*r["inside"], r["stiffness_inside"]] for r in at_level], axis=0)
    outcome.table("intervals_hold", dict(zip(("share", "centre", "width", "stiffness"), inside, strict=True)))
    outcome.check("95 % bands of the stiffness: share that holds the truth", inside[3], 0.9, at_least=True)
    outcome.say("Nominal 95 % intervals of share, centre, width and stiffness hold the truth in "
                + ", ".join(f"{100 * value:.0f}" for value in inside) + " % of these cases.")  # fmt: skip
    outcome.figure(
        "places",
        places_found(damaged, within=WITHIN),
        "Error of the place found, over where the loss is, at three levels of noise. Crosses: not reported.",
    )
    draw_stiffness(outcome, tries)


def draw_stiffness(outcome, tries: dict) -> None:
    """One beam and one bar, from a record far above the noise and from one as loud as the noise."""
    shown = {
        f"{kind}, {level:g} dB above the noise": tries[kind, FIRST_SEED, SHARE, level]
        for kind in ENDS
        for level in (LEVEL_DB, LOWER_LEVELS[-1])
    }
    outcome.figure(
        "stiffness",
        stiffness_found({name: (found, hidden.stiffness, SENSORS) for name, (hidden, found) in shown.items()}),
        "Stiffness found along a beam and a bar, from a record far above the noise and from one as loud as the noise.",
    )


def summary(outcome, kind: str, rows: list[dict]) -> None:
    """How many are found and placed, at each level, and how near the bound that their own records set."""
    for level in (LEVEL_DB, *LOWER_LEVELS):
        own = [r for r in rows if r["level_db"] == level]
        placed = np.mean([r["found"] and r["error"] < WITHIN for r in own])
        outcome.table(f"{kind}_{level:g}_dB", {
            "cases": len(own),
            "found": sum(r["found"] for r in own),
            "placed": placed,
            "largest_error": max(r["error"] for r in own),
            "median_error": np.median([r["error"] for r in own]),
            "median_standard_error": np.median([r["standard_error"] for r in own]),
        })  # fmt: skip
        outcome.say(
            f"{kind}, {level:g} dB: {100 * placed:.0f} % of {len(own)} placed within {100 * WITHIN:g} % of the length,"
            f" the worst {100 * max(r['error'] for r in own):.2g} % away."
        )
        if level == LEVEL_DB:
            outcome.check(
                f"{kind}: share of losses found and placed within 5 % of the length", placed, 1.0, at_least=True
            )
