"""The largest value of a sum of damped exponentials over all time, not over samples of it."""

import numpy as np

SHARE = 1e-6
MOST_ROUNDS = 80
MOST_INTERVALS = 500_000  # to be halved: exponentials that hardly decay leave more


def largest(poles: np.ndarray, amplitudes: np.ndarray, span: float) -> float:
    """max |Re Σ_k a_k e^{λ_k t}| over 0 <= t <= span and all signals, at most a millionth too large, never too small.

    On an interval of width w about t, |g| <= |g(t)| + |g'(t)| w/2 + (w²/8) Σ_k |a_k λ_k²| e^{Re λ_k (t - w/2)}: what
    cannot beat the largest seen is dropped, the rest is halved. Where they hardly decay and too many are left, the
    bound on them is returned, which is never too small either.

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
        bend = (size[signal] * np.exp(np.outer(start, decay))) @ np.abs(poles) ** 2
        upper = value + 0.5 * width * slope + 0.125 * width**2 * bend
        best = max(best, float(value.max()))
        kept = upper > best * (1 + SHARE)
        if not kept.any():
            return best * (1 + SHARE)
        if kept.sum() > MOST_INTERVALS:
            break
        width *= 0.5
        signal, start = np.repeat(signal[kept], 2), np.repeat(start[kept], 2)
        start[1::2] += width
    return float(upper.max())
