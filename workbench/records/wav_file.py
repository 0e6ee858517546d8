"""WAV: one channel per signal, relative to full scale where the samples are integers."""

import warnings
from functools import partial
from pathlib import Path

import numpy as np
from scipy.io import wavfile

from workbench.records.confined import load_confined
from workbench.records.limits import ReadLimits, RecordFileError, check_counts

arrays = partial(load_confined, __name__)  # (path, limits) -> arrays by name, by `load` in a separate process


def load(path: Path, limits: ReadLimits) -> dict[str, np.ndarray]:
    """Sample instants `t` and the channels, by name; to be called in a separate process."""
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="Reached EOF prematurely")  # refuses a truncated file
        rate, samples = wavfile.read(path)
    samples = samples.reshape(samples.shape[0], -1)
    check_counts(path, samples.shape[1], samples.size + samples.shape[0], limits)
    if not rate > 0:
        raise RecordFileError(f"{path}: its sample rate is {rate} Hz; it must be positive")
    if samples.dtype.kind == "u":
        samples = samples.astype(float) - 128.0
        full = 128.0
    else:
        full = -float(np.iinfo(samples.dtype).min) if samples.dtype.kind == "i" else 1.0
    channels = {f"channel {i + 1}": column / full for i, column in enumerate(samples.T)}
    return {"t [s]": np.arange(samples.shape[0]) / rate, **channels}
