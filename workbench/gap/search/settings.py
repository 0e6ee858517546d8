"""Constants of the search for effects, one class for each step that reads them, with units and evidence."""

from dataclasses import dataclass

from workbench.gap.prediction.innovations import LOOSE


@dataclass(frozen=True)
class SearchSettings:
    """Constants that decide whether a set of effects explains the records, and which of two sets is better."""

    slack: float = 0.03  # of the noise power: two good finite-element models differ by so much
    # standard deviations of the mean square of noise: in records of fewer than 20,000 values more than the slack
    chance: float = 3.0
    integration_share: float = 2e-6  # of the gap's power: error of time integration
    sure: float = 30.0  # twice the log-likelihood ratio that settles a choice
    # of the noise power: no set is preferred to a simpler one for a smaller gain, whatever the likelihood ratio
    trifle: float = 0.005
    # of the gap's power above the noise: any law fits so much of a measured gap, since friction of a servo drive varies
    # by a tenth along its rail. A further effect that removes less must remove as large a share as the first
    negligible: float = 0.002
    significant: float = 0.01  # of the noise power: a smaller gain shows an imperfect model, not an effect
    elsewhere: float = 0.1  # of the extent: fits that start closer usually reach the same local minimum
    same_place: float = 0.02  # of the extent: fits as close as this have the same local minimum
    # of the noise power: a set whose cost is higher by more is no alternative to one that explains the gap
    alternative: float = 0.02
    further: int = 100  # iterations like the last: a fit that would still be too high after them is given up
    coarse: float = 2.0  # times the noise: quantisation in smaller steps adds nearly white noise


@dataclass(frozen=True)
class FitSettings:
    """Constants of the nonlinear least-squares fit."""

    damping: float = 1e-3  # of the diagonal of the normal equations, at the first step; less lets fits diverge
    curvature_step: float = 0.1  # of a step: distance over which its curvature is measured
    # bound of geodesic acceleration: twice the correction over the length of the step (Transtrum & Sethna, 2012)
    largest_curvature: float = 0.75
    # of a nominal error, in its unit (a hundredth, say): step of its finite difference. Errors of mass, stiffness and
    # gains may cancel in the response, though each alone shifts the phase of a long record: a longer step is nonlinear
    short: float = 1e-4
    slope_substeps: int = 2  # of a sample, for sensitivities, which need less accuracy than residuals
    # times the usual finite-difference step, for standard errors: with the usual one, the strength of a law and the
    # scale of all readings, which compensate each other, seemed known to 0.03 % where priors know them to 1.2 %
    shorter: float = 0.3
    wider: float = 30.0  # times the usual finite-difference step, where wide steps are asked for: a hundredth
    wider_place: float = 1000.0  # likewise for coordinates of places: a thousandth of the extent
    attempts: int = 7  # steps that are tried from one point
    less_far: float = 6.0  # factor on the damping after a step that failed
    promised: float = 0.1  # of the tolerance: a step with a smaller predicted decrease is not tried


@dataclass(frozen=True)
class ScreeningSettings:
    """Constants of the screening of candidate effects."""

    weaker: float = 0.03  # times the start value: lower bound of an effect's strength
    stronger: float = 30.0  # likewise, upper bound
    most_values: int = 20_000  # values of the residual that are used
    at_once: int = 32  # starts in one batch: with more, residuals of whole records exceed a processor's cache


@dataclass(frozen=True)
class SelectionSettings:
    """Constants of fits to one-step-ahead predictions, and of fits to whole records that follow."""

    fine: int = 8  # substeps of a sample
    targets_a_kind: int = 3  # targets of each kind that are tried as single effects
    tried: int = 16  # sets fitted to one-step-ahead predictions of one record
    likely: int = 10  # of these, sets fitted to two records
    likeliest: int = 5  # of these, sets fitted until convergence
    exchanged: int = 2  # best linear effects at whose places the other linear kinds are tried
    far_behind: float = 10.0  # times the best predicted cost: fits above it are not continued
    # times the noise power one step ahead, or this share of the nominal residual there (with coarse time steps, small
    # noise is below the integration error): a set with a larger residual does not explain the records
    promising: float = 5.0
    promising_share: float = 0.05
    # process noise of the observers of a continuation, one after the other: the smaller, the lower the observer gain
    continuation: tuple[float, ...] = (LOOSE, 0.1 * LOOSE, 0.01 * LOOSE)
    at_hand: float = 10.0  # times the noise power on whole records: from there, a fit to them converges
    close: float = 2.0  # times the least one-step-ahead cost: sets above it are not fitted to whole records
    at_first: int = 5  # iterations on whole records before the best fits are chosen
    running: float = 2.0  # times the best predicted cost on whole records: fits above it are not continued


@dataclass(frozen=True)
class FinishSettings:
    """Constants of the last refinement of a set of effects."""

    finest: int = 32  # substeps of a sample
    all_but: float = 1.5  # cost below which the finest substeps are tried
    stepping: float = 1e-4  # of the gap's power: integration error that coarser substeps may leave
    idle: float = 0.5  # of the noise power: an effect that removes less may be left out
    # of the residual above the noise: where finer substeps leave more than this share, a converged fit is not refined
    no_nearer: float = 0.9
    at_first: int = 4  # iterations of a simpler form on the most informative records
    too_far: float = 30.0  # times the cost of the set: a simpler form that costs more after them is dropped
    tried: int = 2  # iterations at each other place before the best places are chosen
    lower: float = 0.98  # of the cost on these records: another place with a higher cost is no better minimum
    widening: int = 8  # iterations of a set with an effect replaced by a more general one
    # times its strength: start values of an effect at another place
    factors: tuple[float, ...] = (1.0, 0.01, 0.1, 10.0, 100.0)


@dataclass(frozen=True)
class RandomSettings:
    """Constants of the search for a random disturbance."""

    near: float = 0.1  # of the gap's power: a set with less left may only be in another local minimum
    # of the noise power: an effect whose cost is higher by more than the best one's is no alternative
    alternative: float = 0.05
    starts: int = 2  # places from which the fit of a random force starts
    points: int = 4  # named points at which it is tried
    finalists: int = 4  # effects that are fitted to whole records through its whitening filter
    tried: int = 3  # of these, effects that are fitted jointly with it
    beside: int = 2  # effects that are added one by one beside it, at most
    likeliest_sets: int = 2  # other sets of effects with which a random force is tried
    turns: int = 4  # alternations between its fit and that of effects or nominal errors, at most
    settled: float = 0.02  # relative decrease of the cost below which the alternation ends
    # range of the unmodelled force's rms over records, relative: that of forces in the rig follows the input level
    spread: float = 0.5
    # of the first elastic frequency: below it, sensors of rates hardly observe a force, and its estimate drifts
    drifting: float = 0.1
    follows: float = 0.3  # share of its power that inputs and motion predict: friction is as strong at every level


@dataclass(frozen=True)
class InputSettings:
    """Constants of the search with input noise."""

    # times the sensor noise power: the residual above it must be larger for input noise to be estimated; less does not
    # matter to a mean square
    loud: float = 0.5
    white: float = 2.0  # mean square of the whitened residual up to which input noise is accepted
    too_white: float = 0.8  # likewise: if it is smaller, the input noise was overestimated
    # of the residual power without input noise: up to this, nominal errors may have over-fitted it and are refitted
    over_fitted: float = 0.1
    rounds: int = 2  # updates of the sensor noise with input noise given


@dataclass(frozen=True)
class RecordSettings:
    """Constants of a nominal parameter that varies from record to record."""

    # relative deviations at which the cost is evaluated; a parabola interpolates
    tried: tuple[float, ...] = (-0.02, -0.01, -0.005, -0.002, 0.0, 0.002, 0.005, 0.01, 0.02)
    enough: float = 0.3  # share of the residual power above the noise that the deviations must remove
    half: float = 0.5  # of the residual power without: largest residual with a parameter that varies
    clearly: float = 0.9  # of the residual power with a varying stiffness: another parameter must leave less
    sure: float = 4.0  # standard errors by which two records must differ


@dataclass(frozen=True)
class ErrorSettings:
    """Constants of the boundary between errors of a careful model and effects."""

    # logarithms of the factors: larger uniform errors are effects
    most_common: tuple[tuple[str, float], ...] = (("modulus_error", 0.05), ("modal_damping", 0.5))
    # likewise, if only one of them is present
    most_alone: tuple[tuple[str, float], ...] = (("modulus_error", 0.015), ("modal_damping", 0.25))
    smallest_delay: float = 0.01  # of a sample: a sensor that is late by less counts as on time
    sure: float = 4.0  # standard errors by which a sensor must be late
    several: int = 3  # sensors: among so many, one alone is hardly late by chance
    by_chance: float = 1e-3  # probability that independent delays agree as closely
    # logarithm of a gain: a larger error is an effect, if it is also `outlying` times the rms of the other gains. Of
    # ten gains calibrated to 2 %, one is so by chance in 1.7 % of draws, and beyond 5 % alone in 12 %; to 1 %, in none
    most_gain: float = 0.05
    outlying: float = 4.0
    most_moved: float = 0.01  # of the extent: an actuator or sensor that is farther off its place is an effect
    suspect: float = 0.4  # of most_gain and most_moved: larger errors are tested, since one that is wrong biases others
    wrong_transducers: int = 2  # gains and places that are tested
    wide: float = 2.0  # standard errors: an effect whose interval reaches the errors of a careful model may be one


@dataclass(frozen=True)
class PlainSettings:
    """Constants of few effects in place of many nominal errors."""

    plainly: int = 8  # iterations without nominal errors
    briefly: int = 3  # of these, iterations before fits far from the best are dropped
    near: float = 2.0  # times the noise power on the most informative records: fits above it go no further
    needless: float = 6.0  # twice the log-likelihood ratio that one more parameter may gain by chance
    likeliest: int = 4  # kinds that are tried as the one additional effect


@dataclass(frozen=True)
class JointSettings:
    """Constants of joint fits of effects and nominal errors."""

    # largest plausible standard deviation of each group of nominal errors: relative, but for damping (of its
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
    guessed: float = 0.6  # likewise of damping, with errors of each mode: a guess is wrong by a factor of two
    # share of the widest that nominal errors of a careful laboratory keep within; if they are larger, an effect that
    # makes them smaller is named even though the residual is small
    plausible: float = 0.95
    # standard deviations below which a smaller one no longer shortens the description
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
    decisive: float = 300.0  # description length, nats, of a factor e in the residual power above the noise
    last_waves: int = 13  # cosines of a profile error in the last fit, so that intervals allow for short waves
    narrowest: float = 1e-3  # smallest prior standard deviation, of the widest: zero would not be differentiable
    # rounds, most_rounds: updates of the prior variances, at most; rounds after a large decrease of the cost do not
    # count, but most_rounds bounds them
    rounds: int = 4
    most_rounds: int = 12
    falling: float = 0.3  # residual power over that of the round before: a smaller ratio is a large decrease
    # nominal errors: sensitivities to fewer are always taken anew; kept ones took a servo's friction for a damper
    few: int = 16
    # settled, last_settled: relative decrease of the residual power below which the rounds end; in the last fit
    settled: float = 0.02
    last_settled: float = 1e-3
    # anew, still: one-step-ahead fits with new sensitivities, at most, and the relative decrease of the cost in the
    # last iteration of one below which no other follows
    anew: int = 4
    still: float = 0.1
    near: float = 1.0  # times the noise power: with a larger residual above it, no fixed point is sought
    rests: int = 3  # fits with prior variances at the fixed point, at most
    sized: float = 0.2  # change of the logarithm of a prior standard deviation that asks for another of these
    likeliest: int = 200  # updates towards the fixed point, at most, none with a simulation
    # damping of the first step of these fits: more keeps poorly determined errors at their start values
    undamped: float = 1e-8
    iterations: int = 4  # iterations, tolerance: of the fit in each round
    tolerance: float = 1e-4
    last_iterations: int = 6  # last_iterations, last_tolerance: of the last fit, which gives the intervals
    last_tolerance: float = 1e-7
    credible: float = 3.0  # times the stated noise: larger noise is a gap
    # times noise guessed from the quietest bands: white noise through a low pass of 0.97 a sample is 8.1 times as loud
    credible_guess: float = 10.0
    # of a sample: an accelerometer that is later stays on its side of the input steps when an effect is added; a
    # smaller delay may have been due to the gap
    surely_late: float = 0.05
    # times the noise power one step ahead: if nominal errors alone leave more, delays by interpolation are tried
    straight: float = 2.0
    # of a sample: delays and leads of accelerometers that are tried, to find the side of the input steps they read
    delays: tuple[float, ...] = (0.1, 0.25, 0.5)
    # ratio of the power of the change just after a sample to that just before it, at a jump
    jump: float = 10.0


@dataclass(frozen=True)
class StepwiseSettings:
    """Constants of the stepwise selection."""

    shorter: float = 30.0  # description length, nats, that an effect must save to make nominal errors plausible
    # likewise if nominal errors alone are plausible and explain the records: of 19 trials without an effect none saved
    # over 3, of 13 with one that nominal errors had absorbed five saved 15 to 140
    fewer_words: float = 10.0
    # likewise, beyond which it need not be likelier than errors that over-fit: where nothing hides 10 and 19 were
    # saved, by masses and losses of stiffness 34 to 39
    far_fewer_words: float = 25.0
    singles: int = 3  # single effects that are tried as the first
    candidates: int = 4  # sets fitted to the most informative records at each step
    # finalists, near: sets that are fitted to all records, and the largest ratio of their cost to the least
    finalists: int = 2
    near: float = 2.0
    most: int = 4  # effects of a set; no case of the format has more than three
    # share of the residual power above the noise, with nominal errors alone, that the first effect must remove. On
    # practice cases the right one removes over 0.9, the best wrong one under 0.1
    excess: float = 0.5
    # likewise for each further effect: of three, the first two leave much
    further_excess: float = 0.25
    # share of the best candidate's one-step-ahead gain that another must reach to be tried
    promising: float = 0.2
    as_good: float = 0.9  # likewise, to be tried at a second place, or as a simpler effect in its stead
    ahead: float = 0.005  # relative one-step-ahead gain of the best candidate below which none is tried
    simpler: float = 0.05  # relative increase of the residual above the noise that is accepted for a simpler set
    needless: float = 0.3  # likewise, for a set with one effect less
    # of the nominal gap's power: a larger residual is not due to errors of single modes
    of_modes: float = 0.1
    halved: float = 0.5  # of the residual above the noise: errors of each mode that leave less are searched further
    explained: float = 0.01  # of the nominal gap's power above the noise: largest residual of an explanation
    further: float = 1e-3  # likewise: a larger residual calls for another effect
    # likewise: largest residual of one effect without nominal errors that is named although errors must be implausibly
    # large to explain the records. Of 21 trials without an effect, the best single one left over 0.06 of the gap; of 38
    # others, one left 0.013 and was named at 0.02. A mass on a frame leaves 0.007
    almost: float = 0.01
    # likewise: largest residual of several effects that are named; the budget decides whether they explain the gap
    in_part: float = 0.2
    # excess of the residual over the noise power that still counts as noise: a tenth of the noise by amplitude is 0.2
    no_gap: float = 0.15
    # likewise, what nominal errors alone leave without any effect: under 0.02 in 40 trials
    noise_floor: float = 0.05
    # likewise, change of the readings with twice the substeps: if it is larger, finer ones are used
    stepping: float = 0.05
    excluded: float = 1e-3  # probability below which another set is no alternative
    # of the nominal gap's power: with a larger residual, a fit that began one step ahead may have diverged
    astray: float = 0.02


@dataclass(frozen=True)
class PairSettings:
    """Constants of the search for pairs of effects."""

    finalists: int = 4  # pairs that are fitted to whole records when all are searched at once
    more: int = 2  # likewise with one effect given
    astray: float = 1e4  # times the gap's power: the simulation diverges
    moved: float = 0.1  # relative change of a parameter: beyond, half of a pair differs from the effect tried alone
    nearer: float = 0.5  # of the residual of another near miss: below, the same search is repeated
    same: float = 1.1  # of the residual of another fit of the set: below, both converge to the same end
    # of the gap's power: below, simpler forms of a set and other places are tried before other effects
    very_near: float = 0.2 * 0.1
    most: float = 0.3  # of the gap's power: a pair with a smaller residual may be two of three effects
    exchanges: int = 2  # rounds in which either half of the best pair is kept and the other exchanged
    tried_further: int = 2  # best pairs that are tried from other places
    named: int = 4  # best sets that may be named or be alternatives


@dataclass(frozen=True)
class AttributionSettings:
    """Constants of the whole search, from single effects to the verdict."""

    finalists: int = 8  # single effects that are fitted to whole records
    # times the cost of the best: finer substeps bring no worse set to the noise floor before it
    far_behind: float = 2.0
    together: int = 8  # iterations of effects with errors of an identified rig
    briefly: int = 2  # iterations if there may be no effect at all
    laws: int = 2  # one-step-ahead fits of a law beyond the catalogue that are continued on whole records
    shown: int = 7  # other single effects that are fitted only for display
    a_tenth: float = 1.1**2 - 1.0  # excess power of noise that is a tenth larger in amplitude
    very_near: float = 0.01  # of the gap's power: largest residual of an effect that leaves only more noise than stated
    # likewise of modes that are missing and are added before another effect is sought: a cantilever by finite elements
    # with a spring to ground left 0.06, and without them an added mass was named. One with an added mass of 3 % left
    # 0.8, and the number of modes was wrong
    of_modes: float = 0.3
    alike: float = 0.01  # relative tolerance of the cost: smaller differences do not show on an axis of decades


@dataclass(frozen=True)
class IntervalSettings:
    """Constants of the standard errors of parameters."""

    alike: float = 1e-4  # of a parameter, or of the extent: difference between two numerical models of one structure
    most_leverage: float = 0.5  # bound of the leverage of a block on a direction that no other block determines
    blocks: int = 12  # of a record: longer than the correlation of the residual, and enough to estimate its scatter
    careful: float = 0.5  # of the widest: size of a careful model's nominal errors where the records do not show it
    counts: float = 2.0  # errors of a group that this prior size weighs as much as
    rounds: int = 20  # updates of the prior sizes towards their fixed point
    draws: int = 48  # of input noise: the standard error of a standard deviation from 48 draws is a tenth
    straight: float = 0.01  # of the extent: distance over which readings are linear in a place
    secants: int = 4  # after the tangent: each halves the error of the last, at least on a logarithmic scale


SEARCH = SearchSettings()
FIT = FitSettings()
SCREENING = ScreeningSettings()
SELECTION = SelectionSettings()
FINISH = FinishSettings()
RANDOM = RandomSettings()
INPUTS = InputSettings()
RECORDS = RecordSettings()
ERRORS = ErrorSettings()
PLAIN = PlainSettings()
JOINT = JointSettings()
STEPWISE = StepwiseSettings()
PAIRS = PairSettings()
ATTRIBUTION = AttributionSettings()
INTERVALS = IntervalSettings()
