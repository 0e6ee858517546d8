import h5py
import numpy as np
import pytest
import pyuff
from scipy.io import savemat

from workbench.records.files import read_measured, read_record
from workbench.records.frequency_responses import impulse_record, read_frf
from workbench.records.limits import RecordFileError
from workbench.records.record import Channel, Record
from workbench.records.resample import decimate


def test_frf_of_an_oscillator_is_its_impulse_response():
    """1 / (k - m ω² + i c ω) against sin(ω_d t) e^{-σt} / (m ω_d), away from the first samples (the band ends)."""
    mass, omega, zeta, rate, n = 2.0, 40.0, 0.02, 1000.0, 8192
    w = 2 * np.pi * np.fft.rfftfreq(n, 1 / rate)
    frf = 1.0 / (mass * (omega**2 - w**2 + 2j * zeta * omega * w))
    record = impulse_record(frf, sample_rate_hz=rate, channels=(Channel("x", "displacement"),))
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


def test_decimation_keeps_the_hold_of_inputs_and_refuses_a_factor_below_one():
    """A band-limited record came back as one of held inputs, and a factor of 0 as a division by zero."""
    time = 1e-3 * np.arange(600)
    signal, channel = np.sin(20.0 * time)[None], (Channel("x"),)
    record = Record(1e-3, signal, channel, signal, channel, input_hold="band-limited", remarks=("rounded times",))
    fewer = decimate(record, 2)
    assert (fewer.input_hold, fewer.remarks) == (record.input_hold, record.remarks)
    for factor in (0, 2.5):
        with pytest.raises(ValueError, match="the factor of a decimation is a whole number, 1 or more"):
            decimate(record, factor)


def test_read_frf(tmp_path):
    path = tmp_path / "frf.mat"
    savemat(path, {"yspec": np.ones((9, 2), complex), "freq": 100})
    record = read_frf(path, positions=[0.0, 1.0], quantity="acceleration")
    assert record.n_samples == 16
    assert record.positions.tolist() == [0.0, 1.0]
    with pytest.raises(RecordFileError, match="3 positions need"):
        read_frf(path, positions=[0, 1, 2], quantity="acceleration")
    with pytest.raises(RecordFileError, match="holds no array 'frf'"):
        read_frf(path, positions=[0, 1], quantity="acceleration", matrix="frf")
    with pytest.raises(RecordFileError, match="no such file"):
        read_frf(tmp_path / "none.mat", positions=[0], quantity="acceleration")
    (tmp_path / "bad.mat").write_bytes(b"not a mat file")
    with pytest.raises(RecordFileError, match="cannot be read"):
        read_frf(tmp_path / "bad.mat", positions=[0], quantity="acceleration")


LINES = np.linspace(1.0, 40.0, 50)
SPECTRA = np.random.default_rng(0).standard_normal((3, 2, 50)) * (1.0 + 0.5j)


def save(path, arrays):
    if path.suffix == ".mat":
        savemat(path, arrays)
    elif path.suffix == ".npz":
        np.savez(path, **arrays)
    else:
        with h5py.File(path, "w") as file:
            for name, values in arrays.items():
                file[name] = values
    return path


@pytest.mark.parametrize("ending", [".mat", ".npz", ".h5"])
@pytest.mark.parametrize(
    ("arrays", "values", "names"),
    [
        ({"frequency_hz": LINES, "H": SPECTRA}, SPECTRA, ("H 1", "H 2", "H 3")),
        ({"f": LINES, "H": SPECTRA[:, 0].T}, SPECTRA[:, :1], ("H 1", "H 2", "H 3")),
        ({"omega": 2 * np.pi * LINES, "a": SPECTRA[0, 0], "b": SPECTRA[1, 0]}, SPECTRA[:2, :1], ("a", "b")),
    ],
)
def test_arrays_of_frfs_are_read_whichever_way_they_lie(tmp_path, ending, arrays, values, names):
    found = read_measured(save(tmp_path / f"x{ending}", arrays))
    np.testing.assert_allclose(found.values, values, rtol=1e-15)
    np.testing.assert_allclose(found.frequencies_hz, LINES, rtol=1e-14)
    assert found.output_names == names
    np.testing.assert_array_equal(found.select_outputs(names[1:2]).values, found.values[1:2])


def test_complex_arrays_of_matlab_7_3_are_read(tmp_path):
    """They were passed over; outputs and inputs of complex numbers by h5py changed places."""
    matlab = np.zeros(SPECTRA.T.shape, [("real", float), ("imag", float)])
    matlab["real"], matlab["imag"] = SPECTRA.T.real, SPECTRA.T.imag
    for values in (matlab, SPECTRA.T):
        with h5py.File(tmp_path / "x.mat", "w") as file:
            for name, each in {"f": LINES[None], "H": values}.items():
                file.create_dataset(name, data=each).attrs["MATLAB_class"] = np.bytes_("double")
        np.testing.assert_array_equal(read_measured(tmp_path / "x.mat").values, SPECTRA)


def test_lines_up_to_half_the_sample_rate(tmp_path):
    """As pydvma keeps them: the rate under `freq`, the number of samples beside it; or the rate given."""
    told = save(tmp_path / "told.npz", {"yspec": SPECTRA[0].T, "freq": 200, "npts": 98})
    bare = save(tmp_path / "bare.npz", {"yspec": SPECTRA[0].T})
    for found in (read_measured(told), read_measured(bare, sample_rate_hz=200.0)):
        np.testing.assert_allclose(found.frequencies_hz, np.linspace(0.0, 100.0, 50))
    with pytest.raises(RecordFileError, match=r"complex.*give the sample rate"):
        read_measured(bare)


@pytest.mark.parametrize(("n_samples", "kept"), [(128, 65), (128, 64), (99, 50)])
def test_lines_beside_a_sample_rate_alone(tmp_path, n_samples, kept):
    """Those of a discrete Fourier transform, with or without that at half the rate; what was assumed is said."""
    lines, rate = np.fft.rfftfreq(n_samples, 1.0 / 200.0), 200.0
    h = np.fft.rfft(np.random.default_rng(0).normal(size=(2, n_samples)))[:, :kept]
    told = {"npts": n_samples} if n_samples % 2 else {}
    found = read_measured(save(tmp_path / "x.mat", {"H": h, "fs": rate, **told}))
    np.testing.assert_allclose(found.frequencies_hz, lines[:kept], rtol=1e-12)
    assert "lines taken from 0 to" in found.remarks[-1] and "not real" not in found.remarks[-1]
    later = read_measured(save(tmp_path / "later.mat", {"H": h[:, 5:60], "fs": rate}))
    assert "the first is not real, as that at 0 Hz is" in later.remarks[-1]


@pytest.mark.parametrize("told", [{}, {"npts": 128}])
def test_lines_without_that_at_zero_beside_a_sample_rate_alone(tmp_path, told):
    """Only the line at half the rate of a discrete Fourier transform is real then; the modes were a line too low."""
    h = np.fft.rfft(np.random.default_rng(0).normal(size=(2, 128)))[:, 1:]
    found = read_measured(save(tmp_path / "x.mat", {"H": h, "fs": 200.0, **told}))
    np.testing.assert_allclose(found.frequencies_hz, np.fft.rfftfreq(128, 1.0 / 200.0)[1:], rtol=1e-12)
    assert "lines taken from 1.5625 to 100 Hz, as the last is real and the first is not" in found.remarks[-1]


def test_lines_by_another_name_are_not_passed_over_for_a_sample_rate(tmp_path):
    radians = {"H": SPECTRA, "frequency_rad_s": 2.0 * np.pi * LINES}
    np.testing.assert_allclose(read_measured(save(tmp_path / "x.mat", radians)).frequencies_hz, LINES, rtol=1e-14)
    with pytest.raises(RecordFileError, match="leave the sample rate out"):
        read_measured(tmp_path / "x.mat", sample_rate_hz=200.0)
    with pytest.raises(RecordFileError, match="'axis', which increases as frequencies do"):
        read_measured(save(tmp_path / "y.mat", {"H": SPECTRA, "axis": LINES, "fs": 200.0}))


@pytest.mark.parametrize(
    ("arrays", "match"),
    [
        ({"f": LINES[:-1], "H": SPECTRA}, "no axis is as long"),
        ({"f": LINES[:2], "H": SPECTRA[:2, :, :2]}, "which axis they run along is not clear"),
        ({"f": LINES, "w": LINES, "H": SPECTRA}, "two arrays of frequencies"),
        ({"f": LINES, "H": SPECTRA, "G": SPECTRA}, "several complex arrays"),
        ({"f": LINES[::-1], "H": SPECTRA}, "increase from line to line"),
        ({"f": LINES, "H": SPECTRA, "positions": [0.0, 1.0]}, "2 places of 3 points"),
    ],
)
def test_frfs_that_cannot_be_read_as_meant_are_refused(tmp_path, arrays, match):
    with pytest.raises(RecordFileError, match=match):
        read_measured(save(tmp_path / "x.npz", arrays))


def test_a_table_of_real_and_imaginary_parts(tmp_path):
    path = tmp_path / "x.csv"
    columns = [LINES, *(part(row) for row in SPECTRA[:2, 0] for part in (np.real, np.imag))]
    np.savetxt(path, np.column_stack(columns), delimiter=",", comments="",
               header="frequency [Hz],tip real,tip imag,root real,root imag")  # fmt: skip
    found = read_measured(path)
    np.testing.assert_allclose(found.values, SPECTRA[:2, :1], rtol=1e-15)
    assert found.output_names == ("tip", "root")
    with pytest.raises(RecordFileError, match=r"FRFs.*identify_frf"):
        read_record(path)


@pytest.mark.parametrize("header", [
    "Frequency (Hz),Real,Imag", "f,h mag,h phase", "Frequency [Hz],Magnitude (dB),Phase (deg)",
    "Frequency (kHz),Magnitude,Phase [°]",
])  # fmt: skip
def test_a_table_of_two_parts_as_analysers_write_them(tmp_path, header):
    lines, one, other = header.split(",")
    h = SPECTRA[0, 0]
    columns = [
        LINES * (1e-3 if "kHz" in lines else 1.0),
        h.real if one == "Real" else 20.0 * np.log10(np.abs(h)) if "dB" in one else np.abs(h),
        h.imag if other == "Imag" else np.angle(h, deg=other != "h phase"),
    ]
    np.savetxt(tmp_path / "x.csv", np.column_stack(columns), delimiter=",", comments="", header=header)
    found = read_measured(tmp_path / "x.csv")
    np.testing.assert_allclose(found.values[0, 0], h, rtol=1e-12)
    np.testing.assert_allclose(found.frequencies_hz, LINES, rtol=1e-14)


@pytest.mark.parametrize("names", [
    "a [g/lbf] real,a [g/lbf] imag", "a real [g/lbf],a imag [g/lbf]", "a [g/lbf] magnitude [dB],a [g/lbf] phase [deg]",
])  # fmt: skip
def test_units_of_a_table_are_brought_to_si(tmp_path, names):
    """1 g / lbf = 9.80665 / 4.4482216152605 (m/s²) / N, by definition."""
    h = SPECTRA[0, 0]
    parts = [20.0 * np.log10(np.abs(h)), np.angle(h, deg=True)] if "dB" in names else [h.real, h.imag]
    header = f"Frequency [Hz],{names}"
    np.savetxt(tmp_path / "x.csv", np.column_stack([LINES, *parts]), delimiter=",", comments="", header=header)
    found = read_measured(tmp_path / "x.csv")
    np.testing.assert_allclose(found.values[0, 0], h * 9.80665 / 4.4482216152605, rtol=1e-12)
    assert [(c.name, c.quantity, c.unit) for c in found.output_channels] == [("a", "acceleration", "m/s^2")]
    assert found.remarks == ("a: g taken as 9.80665 m/s^2", "a: lbf taken as 4.44822 N")


@pytest.mark.parametrize(
    ("first", "factor"),
    [("Frequency (rad/s)", 2.0 * np.pi), ("omega [rad/s]", 2.0 * np.pi), ("Frequency (CPM)", 60.0), ("f [kHz]", 1e-3)],
)
def test_lines_in_any_unit(tmp_path, first, factor):
    h = SPECTRA[0, 0]
    header = f"{first},a Real ((m/s2)/N),a Imag ((m/s2)/N),Coherence"
    columns = [factor * LINES, h.real, h.imag, 0.0 * LINES + 0.99]
    np.savetxt(tmp_path / "x.csv", np.column_stack(columns), delimiter=",", comments="", header=header)
    found = read_measured(tmp_path / "x.csv")
    np.testing.assert_allclose(found.frequencies_hz, LINES, rtol=1e-12)
    np.testing.assert_allclose(found.values[0, 0], h, rtol=1e-12)
    assert found.output_channels[0].quantity == "acceleration" and found.remarks == ("Coherence: left out",)


@pytest.mark.parametrize("form", ["{0.real!r}{0.imag:+}i", "{0!r}"])
def test_a_table_of_complex_numbers(tmp_path, form):
    """As MATLAB and Python write them."""
    rows = [f"{f!r}," + ",".join(form.format(complex(h)) for h in both)
            for f, both in zip(LINES.tolist(), SPECTRA[:2, 0].T)]  # fmt: skip
    (tmp_path / "x.csv").write_text("\n".join(["f,a [g/N],b", *rows]) + "\n")
    found = read_measured(tmp_path / "x.csv")
    np.testing.assert_allclose(found.values[:, 0] / [[9.80665], [1.0]], SPECTRA[:2, 0], rtol=1e-12)
    assert found.output_names == ("a", "b") and found.output_channels[0].unit == "m/s^2"


@pytest.mark.parametrize(("unit", "degrees"), [("", True), ("", False), (" [rad]", False)])
def test_phases_beyond_a_turn_are_degrees_unless_a_unit_is_told(tmp_path, unit, degrees):
    h = SPECTRA[0, 0]
    phase = np.angle(h, deg=degrees) + (0.0 if degrees or not unit else 40.0 * np.pi)
    header = f"Frequency [Hz],a magnitude,a phase{unit}"
    np.savetxt(
        tmp_path / "x.csv", np.column_stack([LINES, np.abs(h), phase]), delimiter=",", comments="", header=header
    )
    found = read_measured(tmp_path / "x.csv")
    np.testing.assert_allclose(found.values[0, 0], h, rtol=1e-9)
    said = ("a phase: beyond ±2π, so taken as degrees; else call it a phase [rad]",)
    assert found.remarks == (said if degrees else ())


@pytest.mark.parametrize("names", ["a", "a real", "a real,b imag", "a real,a imag,weight", "a real,a phase"])
def test_a_table_of_frequencies_is_no_record(tmp_path, names):
    """It was told to lack a sample rate; with one it would have been taken for signals over time."""
    columns = [LINES] * (1 + len(names.split(",")))
    np.savetxt(tmp_path / "x.csv", np.column_stack(columns), delimiter=",", header=f"f,{names}", comments="")
    with pytest.raises(RecordFileError, match=r"two columns each, NAME real and NAME imag"):
        read_measured(tmp_path / "x.csv", sample_rate_hz=100.0)


def save_58(path, pairs, function=4, lines=LINES, unit="NONE"):
    file = pyuff.UFF(str(path))
    for output, reference, values in pairs:
        file.write_sets(
            pyuff.prepare_58(binary=0, func_type=function, rsp_node=output, rsp_dir=3, ref_node=reference, ref_dir=3,
                             ordinate_spec_data_type=12, orddenom_spec_data_type=13, abscissa_spec_data_type=18,
                             abscissa_axis_units_lab=unit, num_pts=lines.size, abscissa_spacing=1,
                             abscissa_min=lines[0], abscissa_inc=lines[1] - lines[0], x=lines, data=values,
                             return_full_dict=False),
            mode="add",
        )  # fmt: skip
    return path


def test_universal_files_of_frfs(tmp_path):
    pairs = [(j + 1, i + 7, SPECTRA[j, i]) for j in range(3) for i in range(2)]
    found = read_measured(save_58(tmp_path / "x.uff", pairs))
    np.testing.assert_allclose(found.values, SPECTRA, rtol=1e-6)
    np.testing.assert_allclose(found.frequencies_hz, LINES, rtol=1e-6)
    assert [c.quantity for c in found.output_channels] == ["acceleration"] * 3
    assert found.references == ("node 7 direction 3", "node 8 direction 3")
    with pytest.raises(RecordFileError, match="lacks the FRF from node 8 direction 3 to node 3"):
        read_measured(save_58(tmp_path / "less.uff", pairs[:-1]))
    with pytest.raises(RecordFileError, match="complex"):
        read_measured(save_58(tmp_path / "other.uff", pairs[:1], function=9))


@pytest.mark.parametrize(("unit", "factor"), [("rad/s", 2.0 * np.pi), ("rad/sec", 2.0 * np.pi), ("RPM", 60.0)])
def test_lines_of_a_universal_file_are_brought_to_hertz(tmp_path, unit, factor):
    found = read_measured(save_58(tmp_path / "x.uff", [(1, 1, SPECTRA[0, 0])], lines=factor * LINES, unit=unit))
    np.testing.assert_allclose(found.frequencies_hz, LINES, rtol=1e-5)
    with pytest.raises(RecordFileError, match="its abscissa is in 'orders', which is no unit of frequency"):
        read_measured(save_58(tmp_path / "y.uff", [(1, 1, SPECTRA[0, 0])], unit="orders"))


def test_one_output_of_several_inputs(tmp_path):
    """Universal files of it were refused, and of arrays the inputs taken for outputs."""
    one = SPECTRA[:1]
    universal = save_58(tmp_path / "x.uff", [(1, i + 7, one[0, i]) for i in range(2)])
    np.testing.assert_allclose(read_measured(universal).values, one, rtol=1e-6)
    for i, lying in enumerate((one, np.moveaxis(one, -1, 0))):
        found = read_measured(save(tmp_path / f"{i}.npz", {"f": LINES, "H": lying}))
        np.testing.assert_array_equal(found.values, one)
        assert found.references == ("input 1", "input 2") and found.output_names == ("H 1",)


def test_half_of_a_symmetric_matrix_is_filled_by_reciprocity(tmp_path):
    found = read_measured(save_58(tmp_path / "x.uff", [(j + 1, i + 1, SPECTRA[j, i]) for j in range(3) for i in range(2)
                                                       if j >= i]))  # fmt: skip
    np.testing.assert_allclose(found.values[1:], SPECTRA[1:], rtol=1e-6)
    np.testing.assert_allclose(found.values[0], [SPECTRA[0, 0], SPECTRA[1, 0]], rtol=1e-6)
    assert found.remarks == ("by reciprocity, those from node 2 direction 3 to node 1 direction 3",)
