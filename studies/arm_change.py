"""What was changed on a flexible arm between two tests? The rig is identified on the first, the second diagnosed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from scipy.signal import butter, csd, sosfilt, welch

from workbench.draw.gap import plot_single_effects
from workbench.draw.robust import plot_redesign
from workbench.draw.style import COLOURS, new_figure
from workbench.gap.diagnose import diagnose
from workbench.gap.effects.catalogue import CATALOGUE
from workbench.gap.effects.nominal import IdentifiedPrior
from workbench.records.files import read_record
from workbench.records.record import Channel, Record
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate_record
from workbench.robust.plain_law import plain_law
from workbench.robust.redesign import redesign
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam
from workbench.structure.profile import Profile
from workbench.structure.supports import HELD, End, PointDamper, PointMass

NEEDS_DATA = "the folder with before.csv and after.csv of the arm"
LENGTH, MASS_PER_LENGTH, BENDING_STIFFNESS = 0.41354, 0.13664, 0.2100  # the link, from its builders
ROOT_SPRING = 2.498  # N m/rad between hub and link, from its builders: a start
NECK = 0.004  # m of soft beam that stands for that spring
BELIEVED_ABOVE_HZ = 2.0  # below it the free hub drifts with friction and offsets of its drive
BLOCK = 1.0  # s: longer than the memory of what the model leaves
BUILDERS = 0.05  # relative standard deviation that is believed of the builders' mass and stiffness
CONTROLLED, DAMPING = (1, 2), 0.2  # the two lowest modes in which the link bends, and their damping ratio by control
FIGURES = ("hub inertia", "hub damping", "drive gain", "link damping ratio", "root stiffness")


def arm(figures, mass=0.0, at=LENGTH, *, heavier=1.0, stiffer=1.0):
    """The rig from its five unknown figures, with a mass on the link at a distance from the clamp.

    The link may be heavier and stiffer than its builders say, by these factors.
    """
    inertia, damping, gain, ratio, root = figures
    link = Beam(
        length=NECK + LENGTH,
        mass_per_length=heavier * MASS_PER_LENGTH,
        bending_stiffness=Profile(
            lambda x: np.where(x < NECK, root * NECK, stiffer * BENDING_STIFFNESS), breaks=(NECK,)
        ),
        left=End(HELD, 0.0),
        right="free",
        attachments=(
            PointMass(0.0, 0.0, rotary_inertia=inertia),
            PointDamper(0.0, 0.0, rotational_coefficient=damping),
            PointMass(NECK + at, mass),
        ),
        damping=ModalDamping(ratio),
    )
    drive, hub = Actuator("v", 0.0, "moment", gain=gain), Sensor("theta", 0.0, "slope")
    return Rig(link.modes(6), (drive,), (hub,), structure=link)


def believed(record):
    """The part of a record that the model speaks of; linear, so it may be taken before the model as well as after."""
    above = butter(2, BELIEVED_ABOVE_HZ, "high", fs=1.0 / record.sample_time, output="sos")
    v, theta = (sosfilt(above, signal)[None] for signal in record.outputs)
    channels = {"output_channels": (Channel("theta", "slope", at=0.0),), "input_channels": (Channel("v", "moment"),)}
    return Record(sample_time=record.sample_time, outputs=theta, inputs=v, name=record.name, **channels)


def left(rig, record):
    """What a rig leaves of a record: (n_samples,) encoder counts."""
    return (record.outputs - simulate_record(rig, record))[0]


def identified(records, start, at=None):
    """Figures that leave least of the records; where `at` is given, a mass there on all but the first is one more."""

    def residual(p):
        rest = [left(arm(np.exp(p[:5]), *([np.exp(p[5]), at] if at else [])), record) for record in records[1:]]
        return np.concatenate([left(arm(np.exp(p[:5])), records[0]), *rest])

    return least_squares(residual, np.log(start), x_scale=0.1)


def blocks(values):
    """Rows of a second each."""
    size = round(BLOCK / 0.002)
    return values[: values.size // size * size].reshape(-1, size, *values.shape[1:])


def resampled(values, statistic):
    """2.5 % and 97.5 % points of a statistic of the mean over blocks drawn anew."""
    means, rng = blocks(values).mean(axis=1), np.random.default_rng(0)
    drawn = means[rng.integers(means.size, size=(4000, means.size))].mean(axis=1)
    return np.quantile(statistic(drawn), (0.025, 0.975))


def covariance(found):
    """Covariance of fitted numbers whose residual is not white: scores add up over blocks."""
    scores = blocks(found.jac * found.fun[:, None]).sum(axis=1)
    inverse = np.linalg.inv(found.jac.T @ found.jac)
    return inverse @ scores.T @ scores @ inverse


def interval(mass, deviation):
    """95 % of a mass: all that the records tell of it is relative to the mass of the link."""
    reach = 1.96 * np.hypot(deviation, BUILDERS * mass)
    return float(mass - reach), float(mass + reach)


def study(outcome, data: Path) -> None:
    before, after = (believed(read_record(Path(data) / f"{name}.csv")) for name in ("before", "after"))

    rig_fit = identified((before,), (3e-3, 5e-3, 0.05, 0.01, ROOT_SPRING))
    figures = np.exp(rig_fit.x)
    spread = figures * np.sqrt(np.diag(covariance(rig_fit)))
    outcome.table("rig", {n: [f, s] for n, f, s in zip(FIGURES, figures, spread, strict=True)})
    remainder = float(np.sqrt(np.mean(rig_fit.fun**2)))
    repeatable = float(resampled(rig_fit.fun**2, np.sqrt)[1])
    outcome.say(f"before: a residual of {remainder:.2f} of {before.outputs.std():.2f} counts rms")

    rig = arm(figures)
    rig = replace(rig, sensors=(replace(rig.sensors[0], noise_std=repeatable),))
    # what is taken before the model must pass through it unchanged in kind: linear effects only
    linear = tuple(k for k in CATALOGUE if not k.nonlinear and k.path != "environment" and k.name != "truncated_modes")
    doubt = block_diag(covariance(rig_fit), BUILDERS**2, BUILDERS**2)

    def off(errors):
        heavier, stiffer = np.exp(errors[5:])
        return arm(figures * np.exp(errors[:5]), heavier=heavier, stiffer=stiffer)

    verdict = diagnose(rig, (after,), catalogue=linear, name="after", identified=IdentifiedPrior.of(off, doubt))
    outcome.say(verdict.sentence)
    outcome.table("verdict", verdict.to_json())

    best = left(verdict.corrected, after)
    alternatives = {}
    for fit in verdict.attribution.singles:
        if fit.effects[0].kind is not verdict.effects[0].kind:
            more = left(fit.effects[0].apply(rig), after) ** 2 - best**2
            low, _ = resampled(more, lambda mean: mean)
            alternatives[fit.labels[0]] = {
                "more_left": float(more.mean() / np.mean(best**2)),
                "excluded": bool(low > 0),
            }
    outcome.table("single_effects", alternatives)

    # the mass with the rig's own figures free on both tests at once, so that their doubt is in its interval
    joint = identified((before, after), (*figures, 0.01), at=LENGTH)
    places = np.linspace(0.5 * LENGTH, LENGTH, 11)
    elsewhere, masses, intervals, start = [], [], [], np.exp(joint.x)
    for at in places[::-1]:
        found = identified((before, after), start, at=float(at))
        start = np.exp(found.x)
        elsewhere.insert(0, found.fun)
        masses.insert(0, float(start[5]))
        intervals.insert(0, interval(start[5], start[5] * np.sqrt(covariance(found)[5, 5])))
    more = [fun**2 - joint.fun**2 for fun in elsewhere]
    possible = [i for i, excess in enumerate(more) if resampled(excess, lambda mean: mean)[0] <= 0]
    lowest, mass = float(places[min(possible)]), masses[-1]
    anywhere = (min(intervals[i][0] for i in possible), max(intervals[i][1] for i in possible))
    outcome.table(
        "mass",
        {
            "kg": mass,
            "at": LENGTH,
            "ci95_at_tip": intervals[-1],
            "not_excluded_from": lowest,
            "kg_there": masses[min(possible)],
            "ci95_anywhere": anywhere,
        },
    )
    low, high = (1e3 * end for end in intervals[-1])
    outcome.say(f"mass added: {1e3 * mass:.1f} g ({low:.1f} to {high:.1f} g, 95 %), if at the tip, {LENGTH} m out")
    outcome.say(
        f"places from {lowest:.3f} m to the tip cannot be excluded: there it would be"
        f" {1e3 * masses[min(possible)]:.1f} g; wherever it is, {1e3 * anywhere[0]:.1f} to {1e3 * anywhere[1]:.1f} g"
    )

    gap = {"before": float(np.std(left(rig, after))), "after": float(best.std()), "rig itself": remainder}
    outcome.table("counts_rms", gap)
    outcome.check("residual on the second test over that on the first", best.std() / remainder, 1.1)
    outcome.check(
        "alternative single effects that cannot be excluded", sum(not r["excluded"] for r in alternatives.values()), 0
    )
    law = plain_law("coupled", rig, CONTROLLED, damping=DAMPING)
    control = redesign(verdict, law, placement=False)
    outcome.say(f"a controller designed on the first test: {control.sentence}")
    outcome.table("control", control.to_json())
    stable = {
        "designed before": control.present_verification.share_stable,
        "redesigned": control.verification.share_stable,
    }
    for name, share in stable.items():
        outcome.check(f"controller {name}: share of possible arms on which it is stable", share, 1.0, at_least=True)
    outcome.figure("response", _plot_responses(before, after, rig, verdict.corrected), "Hub angle over drive.")
    outcome.figure("single_effects", plot_single_effects(verdict), "Each linear effect alone on the second test.")
    shares = [1.0 + excess.mean() / np.mean(joint.fun**2) for excess in more]
    outcome.figure("place", _plot_place(places, shares, lowest), "Where on the link the mass may be.")
    outcome.figure(
        "control", plot_redesign(control), "The controller designed before, and redesigned, on the heavier arm."
    )


def _response(record, outputs):
    """Size of the hub angle over the drive, from 1 to 36 Hz."""
    rate = 1.0 / record.sample_time
    frequency, cross = csd(record.inputs[0], outputs[0], rate, nperseg=4096)
    _, power = welch(record.inputs[0], rate, nperseg=4096)
    band = (frequency > 1.0) & (frequency < 36.0)
    return frequency[band], np.abs(cross / power)[band]


def _plot_responses(before, after, rig, corrected):
    figure, axes = new_figure(1, 2, width=10, height=4.0, sharey=True)
    first, second = (rig, "the rig, identified here", COLOURS[1], "--"), (corrected, "with the mass", COLOURS[0], "-")
    for ax, record, models in ((axes[0], before, (first,)), (axes[1], after, (first, second))):
        ax.loglog(*_response(record, record.outputs), color=COLOURS[6], linewidth=3.0, alpha=0.4, label="measured")
        for model, label, colour, style in models:
            outputs = simulate_record(model, record)
            label = "the rig of the first test" if record is after and model is rig else label
            ax.loglog(*_response(record, outputs), color=colour, linestyle=style, label=label)
        ax.set(title=f"{record.name} the change", xlabel="frequency [Hz]")
        ax.legend()
    axes[0].set_ylabel("|hub angle / drive| [counts/count]")
    return figure


def _plot_place(places, shares, lowest):
    figure, ax = new_figure(1, 1, width=8, height=3.4)
    ax.plot(1e3 * places, shares, "o-", color=COLOURS[0])
    ax.axvspan(1e3 * lowest, 1e3 * places[-1], color=COLOURS[2], alpha=0.2, label="not excluded (95 %)")
    ax.set(xlabel="distance of the mass from the clamp [mm]", ylabel="residual power / minimum [-]")
    ax.legend()
    return figure
