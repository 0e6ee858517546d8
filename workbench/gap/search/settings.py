"""Constants of the search for effects, one class for each step that reads them, with units and evidence."""

from dataclasses import dataclass

from workbench.gap.prediction.innovations import PROCESS_NOISE


@dataclass(frozen=True)
class SearchSettings:
    """Constants that decide whether a set of effects explains the records, and which of two sets is better."""

    noise_tolerance: float = 0.03  # of the noise power: two good finite-element models differ by so much
    # standard deviations of the mean square of noise: in records of fewer than 20,000 values more than that
    noise_deviations: float = 3.0
    integration_error: float = 2e-6  # of the gap's power: error of time integration
    likelihood_ratio: float = 30.0  # twice the log-likelihood ratio that settles a choice
    # of the noise power: no set is preferred to a simpler one for a smaller gain, whatever the likelihood ratio
    least_gain: float = 0.005
    # of the gap's power above the noise: any law fits so much of a measured gap, since friction of a servo drive varies
    # by a tenth along its rail. A further effect that removes less must remove as large a share as the first
    negligible_share: float = 0.002
    significant_gain: float = 0.01  # of the noise power: a smaller gain shows an imperfect model, not an effect
    distinct_distance: float = 0.1  # of the extent: fits that start closer usually reach the same local minimum
    same_distance: float = 0.02  # of the extent: fits as close as this have the same local minimum
    # of the noise power: a set whose cost is higher by more is no alternative to one that explains the gap
    alternative_margin: float = 0.02
    # iterations like the last: a fit that would still be too high after them is given up
    extrapolated_iterations: int = 100
    # of the gap's power above the noise: largest residual of an explanation, be it one effect alone, although nominal
    # errors would have to be implausibly large, or several beside them. Of 21 trials without an effect, the best single
    # one left over 0.06; of 38 others, one left 0.013 and was named at 0.02. A mass on a frame leaves 0.007
    explained_share: float = 0.01
    halved: float = 0.5  # of the residual above the noise: a set that leaves less is nearer by far
    near_noise: float = 2.0  # times the noise power: a larger residual is not near it
    # times the least cost, or the least that is predicted for whole records: sets above it are followed no further
    max_cost_ratio: float = 2.0
    finalists: int = 4  # sets or effects that are fitted on, where all are searched
    few_finalists: int = 2  # likewise, where some effects are given or a fit takes long
    coarse_step: float = 2.0  # times the noise: quantisation in smaller steps adds nearly white noise


@dataclass(frozen=True)
class FitSettings:
    """Constants of the nonlinear least-squares fit."""

    iterations: int = 8  # of a fit that decides between sets
    damping: float = 1e-3  # of the diagonal of the normal equations, at the first step; less lets fits diverge
    curvature_step: float = 0.1  # of a step: distance over which its curvature is measured
    # bound of geodesic acceleration: twice the correction over the length of the step (Transtrum & Sethna, 2012)
    max_curvature: float = 0.75
    # of a nominal error, in its unit (a hundredth, say): step of its finite difference. Errors of mass, stiffness and
    # gains may cancel in the response, though each alone shifts the phase of a long record: a longer step is nonlinear
    nominal_error_step: float = 1e-4
    sensitivity_substeps: int = 2  # of a sample, for sensitivities, which need less accuracy than residuals
    # times the usual finite-difference step, for standard errors: with the usual one, the strength of a law and the
    # scale of all readings, which compensate each other, seemed known to 0.03 % where priors know them to 1.2 %
    std_step: float = 0.3
    wide_step: float = 30.0  # times the usual finite-difference step, where wide steps are asked for: a hundredth
    wide_place_step: float = 1000.0  # likewise for coordinates of places: a thousandth of the extent
    max_attempts: int = 7  # steps that are tried from one point
    damping_factor: float = 6.0  # factor on the damping after a step that failed
    least_predicted_decrease: float = 0.1  # of the tolerance: a step with a smaller predicted decrease is not tried


@dataclass(frozen=True)
class ScreeningSettings:
    """Constants of the screening of candidate effects."""

    min_strength: float = 0.03  # times the start value: lower bound of an effect's strength
    max_strength: float = 30.0  # likewise, upper bound
    max_values: int = 20_000  # values of the residual that are used
    batch_size: int = 32  # starts in one batch: with more, residuals of whole records exceed a processor's cache


@dataclass(frozen=True)
class SelectionSettings:
    """Constants of fits to one-step-ahead predictions, and of fits to whole records that follow."""

    substeps: int = 8  # substeps of a sample
    targets_per_kind: int = 3  # targets of each kind that are tried as single effects
    fits_to_one_record: int = 16  # sets fitted to one-step-ahead predictions of one record
    fits_to_two_records: int = 10  # of these, sets fitted to two records
    fits_until_convergence: int = 5  # of these, sets fitted until convergence
    max_cost_ratio: float = 10.0  # times the best predicted cost: fits above it are not continued
    # times the noise power one step ahead, or this share of the nominal residual there (with coarse time steps, small
    # noise is below the integration error): a set with a larger residual does not explain the records
    max_residual_ahead: float = 5.0
    max_share_ahead: float = 0.05
    # process noise of the observers of a continuation, one after the other: the smaller, the lower the observer gain
    continuation: tuple[float, ...] = (PROCESS_NOISE, 0.1 * PROCESS_NOISE, 0.01 * PROCESS_NOISE)
    convergence_residual: float = 10.0  # times the noise power on whole records: from there, a fit to them converges
    first_iterations: int = 5  # iterations on whole records before the best fits are chosen


@dataclass(frozen=True)
class FinishSettings:
    """Constants of the last refinement of a set of effects."""

    substeps: int = 32  # substeps of a sample
    refinement_cost: float = 1.5  # cost below which the finest substeps are tried
    integration_error: float = 1e-4  # of the gap's power: integration error that coarser substeps may leave
    redundant_gain: float = 0.5  # of the noise power: an effect that removes less may be left out
    # of the residual above the noise: where finer substeps leave more than this share, a converged fit is not refined
    integration_share: float = 0.9
    first_iterations: int = 4  # iterations of a simpler form on the most informative records
    max_cost_ratio: float = 30.0  # times the cost of the set: a simpler form that costs more after them is dropped
    place_iterations: int = 2  # iterations at each other place before the best places are chosen
    max_place_cost: float = 0.98  # of the cost on these records: another place with a higher cost is no better minimum
    # times its strength: start values of an effect at another place
    strength_factors: tuple[float, ...] = (1.0, 0.01, 0.1, 10.0, 100.0)


@dataclass(frozen=True)
class RandomSettings:
    """Constants of the search for a random disturbance."""

    max_residual_share: float = 0.1  # of the gap's power: a set with less left may only be in another local minimum
    # of the noise power: an effect whose cost is higher by more than the best one's is no alternative
    alternative_margin: float = 0.05
    start_places: int = 2  # places from which the fit of a random force starts
    start_points: int = 4  # named points at which it is tried
    joint_fits: int = 3  # effects, fitted through its whitening filter, that are then fitted jointly with it
    max_effects_beside: int = 2  # effects that are added one by one beside it, at most
    max_alternations: int = 4  # alternations between its fit and that of effects or nominal errors, at most
    # range of the unmodelled force's rms over records, relative: that of forces in the rig follows the input level
    max_rms_spread: float = 0.5
    # of the first elastic frequency: below it, sensors of rates hardly observe a force, and its estimate drifts
    least_frequency: float = 0.1
    # share of its power that inputs and motion predict: friction is as strong at every level
    max_predicted_share: float = 0.3


@dataclass(frozen=True)
class InputSettings:
    """Constants of the search with input noise."""

    # times the sensor noise power: the residual above it must be larger for input noise to be estimated; less does not
    # matter to a mean square
    least_residual: float = 0.5
    # mean square of the whitened residual: if it is smaller, the input noise was overestimated
    min_mean_square: float = 0.8
    # of the residual power without input noise: up to this, nominal errors may have over-fitted it and are refitted
    over_fitted_share: float = 0.1
    noise_updates: int = 2  # updates of the sensor noise with input noise given


@dataclass(frozen=True)
class RecordSettings:
    """Constants of a nominal parameter that varies from record to record."""

    # relative deviations at which the cost is evaluated; a parabola interpolates
    deviations: tuple[float, ...] = (-0.02, -0.01, -0.005, -0.002, 0.0, 0.002, 0.005, 0.01, 0.02)
    least_removed_share: float = 0.3  # share of the residual power above the noise that the deviations must remove
    max_ratio: float = 0.9  # of the residual power with a varying stiffness: another parameter must leave less


@dataclass(frozen=True)
class ErrorSettings:
    """Constants of the boundary between errors of a careful model and effects."""

    # logarithms of the factors: larger uniform errors are effects
    max_uniform: tuple[tuple[str, float], ...] = (("modulus_error", 0.05), ("modal_damping", 0.5))
    # likewise, if only one of them is present
    max_uniform_alone: tuple[tuple[str, float], ...] = (("modulus_error", 0.015), ("modal_damping", 0.25))
    min_delay: float = 0.01  # of a sample: a sensor that is late by less counts as on time
    standard_errors: float = 4.0  # by which a sensor must be late, or two records differ
    several_sensors: int = 3  # sensors: among so many, one alone is hardly late by chance
    coincidence_probability: float = 1e-3  # probability that independent delays agree as closely
    # logarithm of a gain: a larger error is an effect, if it is also `outlier_ratio` times the rms of the others. Of
    # ten gains calibrated to 2 %, one is so by chance in 1.7 % of draws, and beyond 5 % alone in 12 %; to 1 %, in none
    max_gain: float = 0.05
    outlier_ratio: float = 4.0
    max_misplacement: float = 0.01  # of the extent: an actuator or sensor that is farther off its place is an effect
    # of max_gain and max_misplacement: larger errors are tested, since one that is wrong biases others
    tested_share: float = 0.4
    max_wrong_transducers: int = 2  # gains and places that are tested
    # standard errors: an effect whose interval reaches the errors of a careful model may be one
    interval_width: float = 2.0


@dataclass(frozen=True)
class PlainSettings:
    """Constants of few effects in place of many nominal errors."""

    first_iterations: int = 3  # of `FIT.iterations`, before fits far from the best are dropped
    likelihood_ratio: float = 6.0  # twice the log-likelihood ratio that one more parameter may gain by chance


@dataclass(frozen=True)
class JointSettings:
    """Constants of joint fits of effects and nominal errors."""

    # largest plausible standard deviation of each group of nominal errors: relative, but for damping (of its
    # logarithm), delay (of a sample) and place (of the extent). Laboratories keep within them; larger ones are effects
    max_prior_std: tuple[tuple[str, float], ...] = (
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
    # likewise of damping, with errors of each mode: a guess is wrong by a factor of two
    max_guessed_damping: float = 0.6
    # share of `max_prior_std` that nominal errors of a careful laboratory keep within; if they are larger, an effect
    # that makes them smaller is named even though the residual is small
    plausible_share: float = 0.95
    # standard deviations below which a smaller one no longer shortens the description
    negligible_std: tuple[tuple[str, float], ...] = (
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
    residual_nats: float = 300.0  # description length, nats, of a factor e in the residual power above the noise
    final_waves: int = 13  # cosines of a profile error in the last fit, so that intervals allow for short waves
    min_prior_share: float = (
        1e-3  # smallest prior standard deviation, of `max_prior_std`: zero would not be differentiable
    )
    rounds: int = 4  # updates of the prior variances; those after a large decrease of the cost do not count
    max_rounds: int = 12  # likewise, those included
    large_decrease: float = 0.3  # residual power over that of the round before: a smaller ratio is a large decrease
    # nominal errors: sensitivities to fewer are always taken anew; kept ones took a servo's friction for a damper
    few_errors: int = 16
    # relative decrease of the residual power below which the rounds end, or the alternation with the fit of a random
    # force; likewise in the last fit
    round_tolerance: float = 0.02
    final_round_tolerance: float = 1e-3
    max_fits_ahead: int = 4  # fits to one-step-ahead predictions, each with new sensitivities
    # relative decrease of the cost in the last iteration of such a fit, below which no other follows
    least_decrease_ahead: float = 0.1
    # times the noise power: with a larger residual above it, no fixed point is sought
    fixed_point_residual: float = 1.0
    fixed_point_fits: int = 3  # fits with prior variances at the fixed point, at most
    prior_change: float = 0.2  # change of the logarithm of a prior standard deviation that asks for another of these
    fixed_point_updates: int = 200  # updates towards the fixed point, at most, none with a simulation
    # damping of the first step of these fits: more keeps poorly determined errors at their start values
    fixed_point_damping: float = 1e-8
    iterations: int = 4  # of the fit in each round, as is the tolerance
    tolerance: float = 1e-4
    final_iterations: int = 6  # of the last fit, which gives the intervals, as is the tolerance
    final_tolerance: float = 1e-7
    credible_noise: float = 3.0  # times the stated noise: larger noise is a gap
    # times noise guessed from the quietest bands: white noise through a low pass of 0.97 a sample is 8.1 times as loud
    credible_guessed_noise: float = 10.0
    # of a sample: an accelerometer that is later stays on its side of the input steps when an effect is added; a
    # smaller delay may have been due to the gap
    certain_delay: float = 0.05
    # of a sample: delays and leads of accelerometers that are tried, to find the side of the input steps they read
    delays: tuple[float, ...] = (0.1, 0.25, 0.5)
    # ratio of the power of the change just after a sample to that just before it, at a jump
    jump_ratio: float = 10.0


@dataclass(frozen=True)
class StepwiseSettings:
    """Constants of the stepwise selection."""

    saved_nats: float = 30.0  # description length, nats, that an effect must save to make nominal errors plausible
    # likewise if nominal errors alone are plausible and explain the records: of 19 trials without an effect none saved
    # over 3, of 13 with one that nominal errors had absorbed five saved 15 to 140
    saved_nats_beside_plausible: float = 10.0
    # likewise, beyond which it need not be likelier than errors that over-fit: where nothing hides 10 and 19 were
    # saved, by masses and losses of stiffness 34 to 39
    saved_nats_decisive: float = 25.0
    singles: int = 3  # single effects that are tried as the first
    max_effects: int = 4  # effects of a set; no case of the format has more than three
    # share of the residual power above the noise, with nominal errors alone, that the first effect must remove. On
    # practice cases the right one removes over 0.9, the best wrong one under 0.1
    first_removed_share: float = 0.5
    # likewise for each further effect: of three, the first two leave much
    further_removed_share: float = 0.25
    # share of the best candidate's one-step-ahead gain that another must reach to be tried
    tried_gain_share: float = 0.2
    equal_gain_share: float = 0.9  # likewise, to be tried at a second place, or as a simpler effect in its stead
    least_gain_ahead: float = 0.005  # relative one-step-ahead gain of the best candidate below which none is tried
    # relative increase of the residual above the noise that is accepted for a simpler set
    simpler_increase: float = 0.05
    smaller_increase: float = 0.3  # likewise, for a set with one effect less
    # of the nominal gap's power: a larger residual is not due to errors of single modes
    mode_error_share: float = 0.1
    # of the nominal gap's power above the noise: a larger residual calls for another effect
    further_share: float = 1e-3
    # likewise: largest residual of several effects that are named; the budget decides whether they explain the gap
    several_effects_share: float = 0.2
    # excess of the residual over the noise power that still counts as noise: a tenth of the noise by amplitude is 0.2
    noise_excess: float = 0.15
    # likewise, what nominal errors alone leave without any effect, under 0.02 in 40 trials; and largest change of the
    # readings with twice the substeps
    noise_floor: float = 0.05
    min_probability: float = 1e-3  # probability below which another set is no alternative
    # of the nominal gap's power: with a larger residual, a fit that began one step ahead may have diverged
    diverged_share: float = 0.02


@dataclass(frozen=True)
class PairSettings:
    """Constants of the search for pairs of effects."""

    diverged_cost: float = 1e4  # times the gap's power: the simulation diverges
    # relative change of a parameter: beyond, half of a pair differs from the effect tried alone
    parameter_change: float = 0.1
    same_minimum_ratio: float = 1.1  # of the residual of another fit of the set: below, both converge to the same end
    # of the gap's power: below, simpler forms of a set and other places are tried before other effects
    near_share: float = 0.2 * 0.1
    max_residual_share: float = 0.3  # of the gap's power: a pair with a smaller residual may be two of three effects
    exchanges: int = 2  # rounds in which either half of the best pair is kept and the other exchanged
    max_sets: int = 4  # best sets that may be named or be alternatives


@dataclass(frozen=True)
class AttributionSettings:
    """Constants of the whole search, from single effects to the verdict."""

    finalists: int = 8  # single effects that are fitted to whole records
    first_iterations: int = 2  # iterations if there may be no effect at all
    shown_singles: int = 7  # other single effects that are fitted only for display
    tenth_louder: float = 1.1**2 - 1.0  # excess power of noise that is a tenth larger in amplitude
    # of the gap's power: largest residual of missing modes that are added before another effect is sought: a cantilever
    # by finite elements with a spring to ground left 0.06, and without them an added mass was named. One with an added
    # mass of 3 % left 0.8, and the number of modes was wrong
    mode_share: float = 0.3
    # relative tolerance of the cost: smaller differences do not show on an axis of decades
    cost_tolerance: float = 0.01


@dataclass(frozen=True)
class IntervalSettings:
    """Constants of the standard errors of parameters."""

    # of a parameter, or of the extent: difference between two numerical models of one structure
    model_difference: float = 1e-4
    most_leverage: float = 0.5  # bound of the leverage of a block on a direction that no other block determines
    blocks: int = 12  # of a record: longer than the correlation of the residual, and enough to estimate its scatter
    prior_share: float = (
        0.5  # of `max_prior_std`: size of a careful model's nominal errors where the records do not show it
    )
    prior_weight: float = 2.0  # errors of a group that this prior size weighs as much as
    rounds: int = 20  # updates of the prior sizes towards their fixed point
    draws: int = 48  # of input noise: the standard error of a standard deviation from 48 draws is a tenth
    linear_distance: float = 0.01  # of the extent: distance over which readings are linear in a place
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
