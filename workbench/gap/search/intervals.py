"""Standard errors of fitted parameters that hold for an imperfect model and coloured residuals."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from workbench.arrays import scaled_inverse
from workbench.gap.effects.effect import COORDINATES, Effect, Parameter, apply_all
from workbench.gap.effects.nominal import NominalPrior, group_of
from workbench.gap.prediction.noise import noise_of_inputs
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import ALONE, Workers
from workbench.gap.search.fit import Fit, deviations_by_effect, finite_residual, parameters_of, slopes
from workbench.gap.search.settings import INTERVALS, JOINT, SELECTION
from workbench.records.record import Record
from workbench.rig.rig import Rig


def with_intervals(
    rig: Rig, found: Fit, data: FitData, workers: Workers = ALONE, *, wide: bool = False, logged: float = 0.0
) -> Fit:
    """The fit with standard errors whose 95 % intervals are valid although the residual is not white.

    With J the sensitivities, r the residual in units of the noise, and P the precision of the priors,

        cov = Σ_b d_b d_bᵀ + s⁴ A⁻¹ P A⁻¹,    (A - J_bᵀ J_b) d_b = J_bᵀ r_b,
        A = Jᵀ J + s² P,    s² = max(|r|² / n, 1)

    or s² A⁻¹ where that is larger, over blocks b of each record: d_b is the change of the parameters without block b.
    This cluster jackknife (MacKinnon, Nielsen & Webb, J. Applied Econometrics 38 (2023) 671) is not biased low by many
    parameters and few blocks. P is the precision of `_with_plausible_errors`; of the nominal errors as estimated, if an
    effect would be insignificant otherwise. Input noise passes through nonlinear laws, for which no linear filter
    whitens it, so it is drawn: each draw changes the residual by δ and the parameters by A⁻¹ Jᵀ δ. The joint covariance
    is no smaller than any of these in any direction. The relative standard error of a parameter of an effect is at
    least 1e-4.

    Args:
        rig: nominal.
        found: effects, and nominal errors if they were fitted.
        data: fit records.
        workers: processes that share the work.
        wide: long steps, for numerical errors of identified modes; as in `slopes`.
        logged: input noise, as a share of the inputs' rms.
    """
    data = data.finely(SELECTION.substeps)  # integration errors would count as scatter
    residual, jacobian = slopes(rig, found.effects, data, workers=workers, differences="wide" if wide else "central")
    if jacobian.shape[1] == 0:
        return found
    level = max(float(residual @ residual) / residual.size, 1.0)
    jacobian = _with_secants_of_places(rig, found.effects, data, residual, jacobian, level)
    drawn = _changes_by_input_noise(apply_all(rig, found.effects), data, residual, logged)
    linearised = _Linearised(found, tuple(parameters_of(rig, found.effects)), data, residual, jacobian, drawn, level)

    def with_prior_of(effects: Sequence[Effect]) -> Fit:
        return linearised.with_covariance(np.array([_precision(p) for _, p in parameters_of(rig, effects)]))

    plausible = with_prior_of(_with_plausible_errors(rig, found.effects, jacobian, level))
    # nominal errors that could do all that an effect does are those which the search rejected in its favour
    named = [e for e in plausible.effects if not e.kind.applied_first]
    is_significant = all(e.stands_out(rig) and e.is_sure(rig) for e in named)
    return plausible if is_significant else with_prior_of(found.effects)


@dataclass(frozen=True, eq=False)
class _Linearised:
    """A fit and its residual, linear in the free coordinates of the parameters.

    Attributes:
        found: effects as fitted.
        parameters: of `parameters_of`, (n_parameters,).
        data: fit records.
        residual: (n_values,) in units of the noise.
        jacobian: (n_values, n_parameters).
        drawn: (n_draws, n_values) changes of the residual by input noise.
        level: mean square of the residual, at least 1.
    """

    found: Fit
    parameters: tuple[tuple[int, Parameter], ...]
    data: FitData
    residual: np.ndarray
    jacobian: np.ndarray
    drawn: np.ndarray
    level: float

    def with_covariance(self, priors: np.ndarray) -> Fit:
        """The fit with the covariance and standard errors of `with_intervals`, by prior precisions (n_parameters,)."""
        found, level = self.found, self.level
        model_scatter = np.array([_model_scatter(found.effects[i], p) for i, p in self.parameters])
        scale = np.sqrt(np.maximum((self.jacobian**2).sum(axis=0) + level * priors, 1e-300))
        jacobian, priors = self.jacobian / scale, priors / scale**2
        information = jacobian.T @ jacobian + level * np.diag(priors)
        root = _square_root(information)
        inverse = root @ root.T
        without = _jackknife(self.residual, jacobian, self.data, root)
        spread = without.T @ without + level**2 * inverse @ np.diag(priors) @ inverse
        by_noise = self.drawn @ jacobian @ inverse
        of_inputs = by_noise.T @ by_noise / INTERVALS.draws
        variances = np.max([np.diag(spread), level * np.diag(inverse), np.diag(of_inputs)], axis=0).clip(0.0)
        free = np.sqrt(variances / scale**2 + model_scatter**2)
        deviations = deviations_by_effect(found.effects, self.parameters, free)
        effects = (replace(e, std={**e.std, **d}) for e, d in zip(found.effects, deviations, strict=True))
        joint = _no_smaller_sandwich(root, information @ spread @ information, level, len(without))
        joint = _no_smaller(joint, of_inputs) / np.outer(scale, scale) + np.diag(model_scatter**2)
        return replace(found, effects=tuple(effects), covariance=joint)


def _with_secants_of_places(
    rig: Rig, effects: Sequence[Effect], data: FitData, residual: np.ndarray, jacobian: np.ndarray, level: float
) -> np.ndarray:
    """The Jacobian with secants over the standard error, instead of tangents, for places.

    At an antinode, such as the free end of a bar or the middle of a beam, the tangent vanishes: readings change with
    the square of the distance, and the tangent would give a standard error of half the extent.
    """
    jacobian = jacobian.copy()
    for j, (i, parameter) in enumerate(parameters_of(rig, effects)):
        if parameter.name not in COORDINATES:
            continue
        value = effects[i].values[parameter.name]
        room = max(value - parameter.low, parameter.high - value) / parameter.scale
        inwards = 1.0 if parameter.high - value > value - parameter.low else -1.0
        linear_range = INTERVALS.linear_distance * (parameter.high - parameter.low) / parameter.scale
        step = deviation = _conditional_std(jacobian[:, j], level, parameter)
        for _ in range(INTERVALS.secants):
            # for a quadratic, the secant is proportional to the step: the geometric mean converges at once
            step = min(np.sqrt(step * deviation), room)
            if step < linear_range:
                break
            there = {**effects[i].values, parameter.name: value + inwards * step * parameter.scale}
            moved = (*effects[:i], replace(effects[i], values=there), *effects[i + 1 :])
            changed = finite_residual(rig, moved, data)
            if changed is None:
                break
            jacobian[:, j] = inwards * (changed[: residual.size] - residual) / step
            deviation = _conditional_std(jacobian[:, j], level, parameter)
    return jacobian


def _conditional_std(slope: np.ndarray, level: float, parameter: Parameter) -> float:
    """Standard error of a free coordinate, all others given."""
    return float(1.0 / np.sqrt(slope @ slope / level + _precision(parameter)))


def _precision(parameter: Parameter) -> float:
    """Prior precision of a free coordinate: that of its normal prior, or for a place of a uniform one."""
    if parameter.prior_std is not None:
        return 1.0 / parameter.prior_std**2
    if parameter.name in COORDINATES:  # the variance of a uniform distribution over the extent
        return 12.0 * (parameter.scale / (parameter.high - parameter.low)) ** 2
    return 0.0


def _with_plausible_errors(rig: Rig, effects: Sequence[Effect], jacobian: np.ndarray, level: float) -> list[Effect]:
    """The effects, with prior variances of nominal errors that a careful model may have, even if estimated to be zero.

    An effect may mimic nominal errors; the records then do not show that these are zero. For each group

        s² = (k c² + Σ (a² + v)) / (k + n),

    over its n errors a with posterior variances v: errors that the records do not determine have v = s², which leaves
    c, the size in a careful model. s is no smaller than estimated.
    """
    return [
        replace(e, target=_plausible_prior(rig, effects, i, jacobian, level))
        if isinstance(e.target, NominalPrior)
        else e
        for i, e in enumerate(effects)
    ]


def _plausible_prior(rig: Rig, effects: Sequence[Effect], i: int, jacobian: np.ndarray, level: float) -> NominalPrior:
    """The prior variances of `_with_plausible_errors` for the nominal errors, effect i."""
    learnt: NominalPrior = effects[i].target
    normal = jacobian.T @ jacobian / level
    careful = {
        g: max(INTERVALS.prior_share * size, getattr(learnt, g))
        for g, size in JOINT.max_prior_std
        if g in learnt.groups
    }
    sizes = careful
    for _ in range(INTERVALS.rounds):
        believed = replace(effects[i], target=replace(learnt, **sizes))
        parameters = parameters_of(rig, [*effects[:i], believed, *effects[i + 1 :]])
        precision = np.array([_precision(p) for _, p in parameters])
        free = np.array([p.to_free(effects[k].values[p.name]) for k, p in parameters])
        # posterior mean square over prior variance: 1 for an error that the records do not determine
        ratio = precision * (free**2 + np.diag(scaled_inverse(normal + np.diag(precision))))
        groups = np.array([group_of(p.name) if k == i else "" for k, p in parameters])
        sums = {g: size**2 * ratio[groups == g].sum() for g, size in sizes.items()}
        n = {g: INTERVALS.prior_weight + (groups == g).sum() for g in sizes}
        sizes = {
            g: max(np.sqrt((INTERVALS.prior_weight * c**2 + sums[g]) / n[g]), getattr(learnt, g))
            for g, c in careful.items()
        }
    return replace(learnt, **sizes)


def _model_scatter(effect: Effect, parameter: Parameter) -> float:
    """Difference of a free coordinate between two good models of one structure; 0 for nominal errors."""
    if parameter.prior_std is not None:
        return 0.0
    if parameter.logarithmic:
        return INTERVALS.model_difference
    value = effect.values[parameter.name]
    size = parameter.high if parameter.name in COORDINATES else abs(value - (parameter.neutral or 0.0))
    return INTERVALS.model_difference * size / parameter.scale


def _square_root(information: np.ndarray) -> np.ndarray:
    """R of A⁻¹ = R Rᵀ, without parameters of no information; a direction of none has the largest variance."""
    there = np.diag(information) > 0
    values, vectors = np.linalg.eigh(information[np.ix_(there, there)])
    root = np.zeros((there.size, values.size))
    root[there] = vectors / np.sqrt(np.maximum(values, 1e-12 * values.max(initial=0.0)))
    return root


def _no_smaller_sandwich(root: np.ndarray, scatter: np.ndarray, level: float, n_blocks: int) -> np.ndarray:
    """The smallest covariance no smaller than A⁻¹ S A⁻¹ or s² A⁻¹ in any direction.

    With few blocks for many parameters, S is shrunk towards a multiple of s² A.

    Args:
        root: R of A⁻¹ = R Rᵀ.
        scatter: S.
        level: s².
        n_blocks: that S was estimated from.
    """
    relative = root.T @ scatter @ root / level
    own = n_blocks / (n_blocks + len(relative))
    relative = own * relative + (1.0 - own) * np.trace(relative) / len(relative) * np.eye(len(relative))
    return _inflated(np.sqrt(level) * root, relative)


def _no_smaller(covariance: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The smallest covariance no smaller than either in any direction of the first."""
    values, vectors = np.linalg.eigh(covariance)
    there = values > 1e-12 * values[-1]
    vectors, sizes = vectors[:, there], np.sqrt(values[there])
    return _inflated(vectors * sizes, (vectors / sizes).T @ other @ (vectors / sizes))


def _inflated(root: np.ndarray, relative: np.ndarray) -> np.ndarray:
    """R max(C, I) Rᵀ, with R `root` and C `relative`."""
    larger, axes = np.linalg.eigh(relative)
    half = root @ (axes * np.sqrt(np.maximum(larger, 1.0)))
    return np.asarray(half @ half.T)


def _changes_by_input_noise(rig: Rig, data: FitData, residual: np.ndarray, logged: float) -> np.ndarray:
    """Changes of the residual by draws of input noise: (n_draws, n_values); no draws without such noise."""
    if not logged:
        return np.zeros((0, residual.size))
    rng = np.random.default_rng(0)

    def drawn(record: Record) -> Record:
        return replace(record, inputs=record.inputs + logged * noise_of_inputs(record, rng))

    draws = (replace(data, records=tuple(map(drawn, data.records))) for _ in range(INTERVALS.draws))
    return np.array([each.residual(rig) - residual for each in draws])


def _jackknife(residual: np.ndarray, jacobian: np.ndarray, data: FitData, root: np.ndarray) -> np.ndarray:
    """Change of the parameters when each block is left out: (n_blocks, n_parameters)."""
    changes, start = [], 0
    for record in data.counted:
        n_outputs, n_samples = record.outputs.shape
        part = slice(start, start + n_outputs * n_samples)
        left, along = residual[part].reshape(n_outputs, -1), (jacobian[part] @ root).reshape(n_outputs, n_samples, -1)
        for block in np.array_split(np.arange(n_samples), min(INTERVALS.blocks, n_samples)):
            within = along[:, block].reshape(-1, root.shape[1])
            leverage, axes = np.linalg.eigh(within.T @ within)
            score = axes.T @ (within.T @ left[:, block].ravel())
            changes.append(root @ (axes @ (score / (1.0 - np.minimum(leverage, INTERVALS.most_leverage)))))
        start = part.stop
    return np.array(changes)
