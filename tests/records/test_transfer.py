import numpy as np
import pytest
from scipy.io import savemat

from workbench.records.file_error import RecordFileError
from workbench.records.record import Channel, Record
from workbench.records.resample import decimate
from workbench.records.transfer import impulse_record
from workbench.records.transfer_file import read_transfer


def test_transfer_function_of_an_oscillator_is_its_impulse_response():
    """1 / (k - m ω² + i c ω) against sin(ω_d t) e^{-σt} / (m ω_d), away from the first samples (the band ends)."""
    mass, omega, zeta, rate, n = 2.0, 40.0, 0.02, 1000.0, 8192
    w = 2 * np.pi * np.fft.rfftfreq(n, 1 / rate)
    transfer = 1.0 / (mass * (omega**2 - w**2 + 2j * zeta * omega * w))
    record = impulse_record(transfer, sample_rate_hz=rate, channels=(Channel("x", "displacement"),))
    time = record.time
    omega_d = omega * np.sqrt(1 - zeta**2)
    exact = np.exp(-zeta * omega * time) * np.sin(omega_d * time) / (mass * omega_d)
    assert record.n_samples == n
    assert np.abs(record.outputs[0] - exact)[5:-5].max() < 2e-3 * exact.max()


def test_decimation_keeps_poles_and_removes_what_is_above():
    time = np.arange(6000) / 1000.0
    slow, fast = np.exp((-1 + 2j * np.pi * 12) * time), np.exp((-1 + 2j * np.pi * 140) * time)
    record = Record(1e-3, (slow + fast).real[None], (Channel("x"),))
    fewer = decimate(record, 5)
    assert fewer.sample_rate_hz == pytest.approx(200.0)
    lam = -1 + 2j * np.pi * 12
    basis = np.exp(lam * (fewer.time - fewer.time[0]))
    columns = np.column_stack([basis.real, basis.imag])
    left = fewer.outputs[0] - columns @ np.linalg.lstsq(columns, fewer.outputs[0], rcond=None)[0]
    assert np.abs(left).max() < 5e-3
    # the time axis is that of the signal, not of the filter's output
    assert np.abs(fewer.outputs[0] - np.exp(lam * fewer.time).real).max() < 5e-3


def test_read_transfer(tmp_path):
    path = tmp_path / "frf.mat"
    savemat(path, {"yspec": np.ones((9, 2), complex), "freq": 100})
    record = read_transfer(path, positions=[0.0, 1.0], quantity="acceleration")
    assert record.n_samples == 16
    assert record.positions.tolist() == [0.0, 1.0]
    with pytest.raises(RecordFileError, match="3 positions need"):
        read_transfer(path, positions=[0, 1, 2], quantity="acceleration")
    with pytest.raises(RecordFileError, match="holds no array 'frf'"):
        read_transfer(path, positions=[0, 1], quantity="acceleration", matrix="frf")
    with pytest.raises(RecordFileError, match="no such file"):
        read_transfer(tmp_path / "none.mat", positions=[0], quantity="acceleration")
    (tmp_path / "bad.mat").write_bytes(b"not a mat file")
    with pytest.raises(RecordFileError, match="cannot be read"):
        read_transfer(tmp_path / "bad.mat", positions=[0], quantity="acceleration")
