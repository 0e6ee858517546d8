"""The peak of a sum of damped exponentials in continuous time."""

import numpy as np

TOLERANCE = 1e-6  # relative, of the peak
MOST_ROUNDS = 80
MOST_INTERVALS = 500_000  # to be halved; lightly damped exponentials may need more


def largest(poles: np.ndarray, amplitudes: np.ndarray, span: float) -> float:
    """max |Re Σ_k a_k e^{λ_k t}| over 0 <= t <= span and all signals: an upper bound, a millionth too large at most.

    On an interval of width w about t, |g| <= |g(t)| + |g'(t)| w/2 + (w²/8) Σ_k |a_k λ_k²| e^{Re λ_k (t - w/2)}.
    Intervals whose bound is below the largest value so far are dropped, the others halved. If too many intervals are
    left, as of lightly damped exponentials, their upper bound is returned, which may be further above the maximum.

    Args:
        poles: (n_poles,), none to the right of the axis.
        amplitudes: (n_signals, n_poles).
        span: s; infinite where every pole decays.
    """
    size, decay = np.abs(amplitudes), poles.real
    ends = np.log(1e-12) / decay.max() if decay.max() < 0 else np.inf
    span = min(span, ends)
    count = int(np.clip(np.ceil(span * np.abs(poles).max()), 8, 20_000))
    width = span / count
    signal = np.repeat(np.arange(len(amplitudes)), count)
    start = np.tile(width * np.arange(count), len(amplitudes))
    best = 0.0
    for _ in range(MOST_ROUNDS):
        terms = np.exp(np.outer(start + 0.5 * width, poles)) * amplitudes[signal]
        value, slope = np.abs(terms.sum(axis=1).real), np.abs((terms @ poles).real)
        curvature = (size[signal] * np.exp(np.outer(start, decay))) @ np.abs(poles) ** 2
        upper = value + 0.5 * width * slope + 0.125 * width**2 * curvature
        best = max(best, float(value.max()))
        kept = upper > best * (1 + TOLERANCE)
        if not kept.any():
            return best * (1 + TOLERANCE)
        if kept.sum() > MOST_INTERVALS:
            break
        width *= 0.5
        signal, start = np.repeat(signal[kept], 2), np.repeat(start[kept], 2)
        start[1::2] += width
    return float(upper.max())
