"""Constants of the search for effects: all of them, by the step that reads them, each with its unit and reason."""

from dataclasses import dataclass

from workbench.gap.prediction.innovations import LOOSE


@dataclass(frozen=True)
class SearchSettings:
    """Constants of what counts as an explanation, and as a better one."""

    slack: float = 0.03  # of the noise power: what two good finite-element models may differ by
    # standard deviations of the mean square of noise, which in records of fewer than 20,000 values is more than that
    chance: float = 3.0
    integration_share: float = 2e-6  # of the gap's power: errors of stepping
    sure: float = 30.0  # twice the logarithm of a likelihood ratio that settles a choice
    # of the noise power: no set is preferred to a simpler one for less, whatever the likelihood says
    trifle: float = 0.005
    significant: float = 0.01  # of the noise power: less is no effect but an imperfect model
    elsewhere: float = 0.1  # of the extent: nearer, two places are in one valley of the cost at first
    same_place: float = 0.02  # of the extent: nearer, fits go on to the same end
    rival: float = 0.02  # of the noise power: what is farther behind what explains the records is no rival of it
    further: int = 100  # iterations like the last: a cost that they leave too high comes no lower in time
    coarse: float = 2.0  # times the noise: below, rounding errors are all but white and of no signal


@dataclass(frozen=True)
class FitSettings:
    """Constants of a fit."""

    damping: float = 1e-3  # of the first step, of the diagonal of the normal equations; less is free to go astray
    bent: float = 0.1  # of a step: the stretch over which its curvature is taken
    # of a step: what it may turn by, twice that turn over its length (Transtrum & Sethna, 2012)
    most_bent: float = 0.75
    # of an error of the model, in its unit (a hundredth, say): the step of its slope. Mass, stiffness and gains may
    # alter nothing together, though each by itself turns the phase of a long record: what a long step bends hides that
    short: float = 1e-4
    slope_substeps: int = 2  # of a sample, for slopes: they need not be as exact as residuals
    wider: float = 30.0  # times the steps of a fit: of numbers a hundredth
    wider_place: float = 1000.0  # likewise: of a place a thousandth
    attempts: int = 7  # steps that are tried from one place
    less_far: float = 6.0  # times the damping of a step that failed: of the next, shorter one
    promised: float = 0.1  # of the tolerance: a step that promises less is not worth trying


@dataclass(frozen=True)
class ScreeningSettings:
    """Constants of the screening of candidate effects."""

    weaker: float = 0.03  # times its strength at the start: the least that an effect may turn out to have
    stronger: float = 30.0  # likewise, the most
    most_values: int = 20_000  # of the errors that are screened
    at_once: int = 32  # starts: of more, the errors of whole records no longer stay in a processor's cache


@dataclass(frozen=True)
class SelectionSettings:
    """Constants of fits one sample ahead, and of those to whole records that follow."""

    fine: int = 8  # substeps of a sample
    targets_a_kind: int = 3  # of single effects that are tried
    tried: int = 16  # sets that are fitted one sample ahead to one record
    likely: int = 10  # likewise, to two
    likeliest: int = 5  # likewise, to their end
    exchanged: int = 2  # likeliest effects in whose places other kinds are tried
    far_behind: float = 10.0  # times the least promise: what is not fitted to its end
    # times the noise one sample ahead, or this share of what the nominal rig leaves there, where steps of half a sample
    # cost more than a small noise: more is left by no set that explains the records
    promising: float = 5.0
    promising_share: float = 0.05
    # random forces of the observers of a continuation, one after the other: the less, the lower the gain
    continuation: tuple[float, ...] = (LOOSE, 0.1 * LOOSE, 0.01 * LOOSE)
    at_hand: float = 10.0  # times the noise: so near, whole records tell the way
    close: float = 2.0  # times the least cost ahead: what may still come first on whole records
    at_first: int = 5  # iterations on whole records, before it is seen which sets go on
    running: float = 2.0  # times the least promise on whole records: what is fitted to its end


@dataclass(frozen=True)
class FinishSettings:
    """Constants of what brings a set of effects to its end."""

    finest: int = 32  # substeps of a sample
    all_but: float = 1.5  # cost below which they are tried
    stepping: float = 1e-4  # of the gap's power: what coarser substeps may leave of it
    idle: float = 0.5  # of the noise power: what an effect may take away and still be none
    # of what a fit at rest leaves above the noise: finer steps that leave more bring it no nearer
    no_nearer: float = 0.9
    at_first: int = 4  # iterations of a simpler form on the quick records
    too_far: float = 30.0  # times a set's cost after them: it is no simpler form of it
    tried: int = 2  # iterations at each other place, before the likeliest are chosen
    lower: float = 0.98  # of the cost on the quick records: no lower, another place is the same valley or a worse one
    apart: float = 0.02  # of the extent: nearer, a place is the same valley
    widening: int = 8  # iterations of a set with an effect as what it is a limiting case of
    # of its strength, that an effect is tried with at another place
    factors: tuple[float, ...] = (1.0, 0.01, 0.1, 10.0, 100.0)


@dataclass(frozen=True)
class RandomSettings:
    """Constants of the search beside a random disturbance."""

    near: float = 0.1  # of the gap's power left: a set this near may only stand in the wrong valley
    rival: float = 0.05  # of the noise power: what is farther behind the best effect beside it is no rival
    starts: int = 2  # places that the fit of a random force starts from
    points: int = 4  # named points that it is tried at
    finalists: int = 4  # effects beside it that are fitted to whole records
    tried: int = 3  # of them, those fitted with it
    likeliest_sets: int = 2  # of other effects, that a random force is tried beside
    turns: int = 4  # of it and errors of the nominal model, each beside the other, at most
    settled: float = 0.02  # of what is left: a turn that takes away less is the last
    # of the unmodelled force's level over records: most forces of the rig's own follow the inputs' level
    spread: float = 0.5
    # of the first elastic frequency: sensors of rates hardly see a force below, and its estimate drifts
    drifting: float = 0.1
    follows: float = 0.3  # share of it that inputs and motion account for: friction is as strong at every level


@dataclass(frozen=True)
class InputSettings:
    """Constants of the search beside noise of the logged inputs."""

    white: float = 2.0  # mean square, white, that a set may leave beside that noise for a search to go on beside it
    # of what a set leaves without that noise: errors of the model that bent to it may leave so much beside it
    bent: float = 0.1
    rounds: int = 2  # rounds of learning the sensors' noise beside it


@dataclass(frozen=True)
class RecordSettings:
    """Constants of a figure that differs from record to record."""

    # deviations, a parabola between them
    tried: tuple[float, ...] = (-0.02, -0.01, -0.005, -0.002, 0.0, 0.002, 0.005, 0.01, 0.02)
    enough: float = 0.3  # share of what a step leaves above the noise that deviations of records must take away
    half: float = 0.5  # of what is left without: what a figure that differs must leave, at most
    clearly: float = 0.9  # of what another figure leaves: the first is preferred to what leaves more
    blocks: int = 12  # a record, whose scatter tells how sure its deviation is
    sure: float = 4.0  # standard deviations that two records must be apart by, for the scatter to be more than chance


@dataclass(frozen=True)
class PlainSettings:
    """Constants of few effects in place of many small errors."""

    # logarithms: more is an effect of its own
    most_common: tuple[tuple[str, float], ...] = (("modulus_error", 0.05), ("modal_damping", 0.5))
    # likewise, where only one of them is there
    most_alone: tuple[tuple[str, float], ...] = (("modulus_error", 0.015), ("modal_damping", 0.25))
    plainly: int = 8  # iterations without errors
    briefly: int = 3  # likewise, after which those go on that may come near
    punctual: float = 0.01  # of a sample: sensors that are late by less are not
    sure: float = 4.0  # standard deviations that a sensor must be late by to be so
    near: float = 2.0  # times the noise power that a fit may leave of the quick records, to be fitted to all
    needless: float = 6.0  # twice the log-likelihood that one number more may gain by chance
    several: int = 3  # sensors, of which one alone is hardly late by chance
    by_chance: float = 1e-3  # probability that sensors, each late by itself, are as late as one another
    likeliest: int = 4  # kinds of the one more that are tried
    # logarithm of a gain: more is an effect of its own, where it is `outlying` times the rms of the others besides. Of
    # ten gains calibrated to 2 %, one is so by chance in 1.7 % of draws, and beyond 5 % alone in 12 %; to 1 %, in none
    most_gain: float = 0.05
    outlying: float = 4.0
    most_moved: float = 0.01  # of the extent: an actuator or a sensor that stands farther off is an effect of its own
    suspect: float = 0.4  # share of most_gain from which on a gain is asked: a wrong one gives some of itself to others
    wrong_gains: int = 2  # how many are asked


@dataclass(frozen=True)
class JointSettings:
    """Constants of fits beside errors of the nominal model."""

    # largest standard deviation that is believed of each group of nominal errors; relative, but for damping (of its
    # logarithm), delay (of a sample) and place (of the extent). Laboratories keep within them; larger ones are effects
    widest: tuple[tuple[str, float], ...] = (
        ("stiffness", 0.015),
        ("mass", 0.015),
        ("frequency", 0.01),
        ("coupling", 0.02),
        ("damping", 0.25),
        ("delay", 0.5),
        ("gain", 0.02),
        ("place", 0.004),
        ("shape", 0.05),
        ("record", 0.02),
    )
    guessed: float = 0.6  # likewise of damping, where each mode is off by itself: a guess is off by a factor of two
    # share of the widest that errors of a careful laboratory keep within; where they are larger, an effect that makes
    # them smaller is named although they leave little
    plausible: float = 0.95
    # standard deviations below which smaller ones save nothing
    small: tuple[tuple[str, float], ...] = (
        ("stiffness", 0.004),
        ("mass", 0.004),
        ("frequency", 0.001),
        ("coupling", 0.001),
        ("damping", 0.1),
        ("delay", 0.1),
        ("gain", 0.002),
        ("place", 0.0004),
        ("shape", 0.002),
        ("record", 0.001),
    )
    decisive: float = 300.0  # description length, nats, of a factor e in the power that is left above the noise
    last_waves: int = 13  # cosines of a variation in the last fit, so that intervals allow for what fewer cannot follow
    narrowest: float = 1e-3  # smallest, as a share of the widest: what is learnt to be none stays differentiable
    # rounds, most_rounds: of learning the sizes, at most; those that a fall of the cost went before do not count as
    # such, but are not without end
    rounds: int = 4
    most_rounds: int = 12
    falling: float = 0.3  # share of what was left that a round leaves where the cost falls
    few: int = 16  # errors, of which slopes are taken anew: kept ones took a servo's friction for a damper
    # settled, last_settled: share of what is left that a round must have taken away for another; in the last fit
    settled: float = 0.02
    last_settled: float = 1e-3
    # anew, still: fits one sample ahead, at most, and share of the cost that the last iteration of one must have taken
    # away for another
    anew: int = 4
    still: float = 0.1
    near: float = 1.0  # times the noise: where more is left above it, sizes are not led to rest
    rests: int = 3  # fits to where sizes come to rest, at most
    sized: float = 0.2  # logarithm of a size: what it must change by for another of these
    likeliest: int = 200  # steps of the sizes to where they come to rest, at most, without a simulation
    # first damping of these fits: more holds what the records hardly tell apart where it is
    undamped: float = 1e-8
    iterations: int = 4  # iterations, tolerance: of the fit in each round
    tolerance: float = 1e-4
    last_iterations: int = 6  # last_iterations, last_tolerance: of the last fit, which intervals are taken from
    last_tolerance: float = 1e-7
    credible: float = 3.0  # times the stated noise that noise found may be; more is a gap
    # times noise guessed by the quietest bands: white noise through a low pass of 0.97 a sample is 8.1 times as loud
    credible_guess: float = 10.0
    # of a sample: an accelerometer that is later stays on its side of the jumps when an effect is added; what was seen
    # of the others may have been the gap
    surely_late: float = 0.05
    # times the noise one sample ahead: errors alone that leave more may miss that sensors are late by straight lines
    straight: float = 2.0
    # of a sample: what accelerometers are tried to be late or early by, to see which side of jumps they read
    delays: tuple[float, ...] = (0.1, 0.25, 0.5)
    # times the power of the change over the span before a sample that the change after it has at a jump
    jump: float = 10.0


@dataclass(frozen=True)
class StepwiseSettings:
    """Constants of the stepwise selection."""

    shorter: float = 30.0  # description length, nats, that an effect which makes errors plausible must save
    # likewise where errors alone are plausible and leave only noise: of 19 trials that hide nothing no effect saved
    # over 3, of 13 that hide one which errors stood in for five saved 15 to 140
    fewer_words: float = 10.0
    singles: int = 3  # effects alone, the likeliest beside errors, that are tried as the first
    candidates: int = 4  # sets fitted on whole records at each step
    # finalists, near: how many of them are fitted to all records, and times the least cost of what may come first
    finalists: int = 2
    near: float = 2.0
    most: int = 4  # effects of a set; no case of the format hides more than three
    # share of what errors of the nominal model leave above the noise that the first effect must take away. On practice
    # cases the right one takes over 0.9, the best wrong one under 0.1
    excess: float = 0.5
    # likewise of what other effects leave, for one more beside them: of three, two leave much
    further_excess: float = 0.25
    # share of the nominal gap's power above the noise: one more that takes away less must take away as much of what
    # others leave as the first does. What is left of a measured gap bends to any law; a servo drive's friction varies
    # by a tenth along its rail
    least: float = 0.002
    # share of what the best candidate takes away one sample ahead that another must take away to be tried
    promising: float = 0.2
    as_good: float = 0.9  # likewise, for a kind to be tried at a second place too, or one of fewer numbers in its stead
    ahead: float = 0.005  # share of the cost one sample ahead that the best candidate must take away to be tried at all
    simpler: float = 0.05  # share by which a set may leave more above the noise and still be taken for being simpler
    needless: float = 0.3  # likewise, for a set with one effect less
    # share of the nominal gap's power from which on errors of each mode, small as they are, cannot be what is missing
    of_modes: float = 0.1
    halved: float = 0.5  # share of what others leave above the noise that makes errors of each mode worth a search
    explained: float = 0.01  # share of the nominal gap's power above the noise that an explanation may leave
    further: float = 1e-3  # likewise, that a further effect is looked for to explain
    in_part: float = 0.2  # likewise, for effects that are named although something else is there
    # share of the noise power above it that is no gap: a tenth of the noise by amplitude is 0.2 of its power
    no_gap: float = 0.15
    # likewise, that errors of the model alone leave in trials that hide nothing: under 0.02 in 40 of them
    noise_floor: float = 0.05
    # likewise, that substeps twice as fine may move the readings by; where it is more, the search goes on by finer ones
    stepping: float = 0.05
    excluded: float = 1e-3  # probability below which another set that explains the records is no rival
    # share of the nominal gap's power from which on a fit that began one sample ahead may have gone astray
    astray: float = 0.02
    # times the noise of the sensors that a set must leave above it for noise of the inputs to be estimated from it;
    # less of it does no harm to a mean square
    loud: float = 0.5
    # mean square, white, beside noise of the inputs, for less of which that was not what was left
    too_white: float = 0.8


@dataclass(frozen=True)
class PairSettings:
    """Constants of the search for pairs of effects."""

    finalists: int = 4  # pairs that are fitted to whole records, of all at once
    more: int = 2  # likewise, of those with one given
    astray: float = 1e4  # times the gap's power: the motion of whole records runs away
    moved: float = 0.1  # of a number: what makes the half of a pair another one than it was alone
    nearer: float = 0.5  # of what another near miss leaves: what makes one worth the same search again
    same: float = 1.1  # of the gap left by a set: nearer, its fits end alike
    # of the gap's power: what is tried in simpler forms, and from other places before other singles
    very_near: float = 0.2 * 0.1
    most: float = 0.3  # of the gap's power left: a pair that leaves less may be two of three
    least: float = 0.002  # likewise: what is left of a measured gap bends to any law
    exchanges: int = 2  # rounds of keeping either half of the best pair ahead
    tried_further: int = 2  # pairs, best first, that are tried from other places too
    named: int = 4  # sets, best first, that may be named or be rivals


@dataclass(frozen=True)
class LawSettings:
    """Constants of the search for a law beyond the catalogue."""

    tried: int = 2  # fits of such a law, one sample ahead, that go on to whole records


@dataclass(frozen=True)
class AttributionSettings:
    """Constants of the course of a search, from single effects to the verdict."""

    finalists: int = 8  # single effects that are fitted to whole records
    # finer steps bring no set this many times as costly as another to the noise floor before it
    far_behind: float = 2.0
    together: int = 8  # iterations of effects and errors of an identified rig
    briefly: int = 2  # iterations, where there may be no effect at all
    shown: int = 7  # others that are, where they are to be shown beside them
    a_tenth: float = 1.1**2 - 1.0  # of the noise by amplitude, as a share of its power
    very_near: float = 0.01  # of the gap's power: what is left by an effect that explains all but louder noise
    alike: float = 0.01  # of a cost: nearer, two look the same on an axis of decades


@dataclass(frozen=True)
class IntervalSettings:
    """Constants of the standard deviations of what is found."""

    alike: float = 1e-4  # of a number, or of the extent: how far two numerical routes to the same records put it apart
    most_leverage: float = 0.5  # of a block on a direction that it alone tells: what there is no telling without it
    blocks: int = 12  # a record: long beside the correlation of what is left, many enough to scatter
    careful: float = 0.5  # share of the widest that errors of a careful model have, where the records do not tell them
    counts: float = 2.0  # errors of a group, that this belief weighs as much as
    rounds: int = 20  # of the sizes, to where they come to rest
    draws: int = 48  # of noise of the logged inputs: a standard deviation of 48 is known to a tenth
    straight: float = 0.01  # of the extent: how far from a place readings are taken to change in proportion
    secants: int = 4  # after the tangent: each halves, on a logarithmic scale at least, what the last was off by


SEARCH = SearchSettings()
FIT = FitSettings()
SCREENING = ScreeningSettings()
SELECTION = SelectionSettings()
FINISH = FinishSettings()
RANDOM = RandomSettings()
INPUTS = InputSettings()
RECORDS = RecordSettings()
PLAIN = PlainSettings()
JOINT = JointSettings()
STEPWISE = StepwiseSettings()
PAIRS = PairSettings()
LAW = LawSettings()
ATTRIBUTION = AttributionSettings()
INTERVALS = IntervalSettings()
