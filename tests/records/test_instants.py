"""The rate of a record whose instants are rounded, jitter, are uneven, lack a sample, or state no unit."""

import numpy as np
import pytest
from scipy.optimize import linprog

from workbench.records.files import read_record
from workbench.records.limits import RecordFileError

RATE = 1000.0
EVEN = np.arange(3000) / RATE


def decay(time, seed=0):
    """Three decaying modes at two sensors, in closed form, with noise."""
    f, zeta = 2.0 * np.pi * np.array([12.0, 75.2, 210.6]), np.array([0.008, 0.006, 0.005])
    modes = np.exp(-np.outer(time, zeta * f)) * np.sin(np.outer(time, f) + 0.3)
    moves = modes @ np.array([[1.0, 2.0], [0.8, -1.0], [0.5, 1.0]])
    return moves + 2e-3 * np.random.default_rng(seed).standard_normal(moves.shape)


def read(tmp_path, times, values=None, name="t (s)", **options):
    values = decay(EVEN)[: len(times)] if values is None else values
    path = tmp_path / "x.csv"
    path.write_text(
        f"{name},a,b\n" + "".join(f"{t},{a:.6g},{b:.6g}\n" for t, (a, b) in zip(times, values, strict=True))
    )
    return read_record(path, **options)


def rates_by_linear_programme(written, rounding):
    """The rates of even instants, each of which was rounded down to what is written."""
    index = np.arange(written.size)
    both = np.column_stack([index, np.ones(index.size)])
    bounds = np.r_[written + rounding, -written]
    ends = [
        linprog([c, 0.0], A_ub=np.r_[both, -both], b_ub=bounds, bounds=[(None, None)] * 2).x[0] for c in (1.0, -1.0)
    ]
    return 1.0 / ends[1], 1.0 / ends[0]


@pytest.mark.parametrize(("rounding", "offset"), [(1.0, 0.437), (0.1, 0.0312), (0.01, 0.00437)])
@pytest.mark.parametrize("how", [np.floor, np.round])
def test_rounded_instants_give_the_roundest_rate_that_they_allow(tmp_path, rounding, offset, how):
    time = np.arange(4000) / RATE
    written = how((time + offset) / rounding) * rounding
    record = read(tmp_path, [f"{t:.2f}" for t in written], decay(time))
    assert record.sample_rate_hz == pytest.approx(RATE, rel=1e-12)
    low, high = rates_by_linear_programme(np.round(written, 2), rounding)
    said = record.remarks[0].split("rates from ")[1].split(" Hz")[0].split(" to ")
    assert [float(rate) for rate in said] == pytest.approx([low, high], rel=1e-6)
    assert ("`sample_rate_hz`" in record.remarks[0]) == (high / low > 1.0001)


def test_a_stated_rate_settles_what_rounded_instants_leave_open(tmp_path):
    written = [f"{t:.0f}" for t in np.floor(EVEN + 0.437)]
    assert read(tmp_path, written, sample_rate_hz=1000.25).sample_rate_hz == pytest.approx(1000.25)
    with pytest.raises(RecordFileError, match="not at 1010 Hz"):
        read(tmp_path, written, sample_rate_hz=1010.0)
    short = [f"{t:.0f}" for t in np.floor(EVEN[:1500] + 0.437)]
    with pytest.raises(RecordFileError, match=r"allow any rate above 93\d[.\d]* Hz, which is too uncertain"):
        read(tmp_path, short)
    assert read(tmp_path, short, sample_rate_hz=1000.0).sample_rate_hz == pytest.approx(1000.0)


@pytest.mark.parametrize("jitter", [20e-6, 300e-6])
@pytest.mark.parametrize("sampled", ["evenly", "unevenly"])
def test_jitter_of_the_instants_alone_is_told_from_uneven_samples(tmp_path, jitter, sampled):
    """Against the same modes at the instants of the record."""
    instants = EVEN + np.random.default_rng(1).uniform(0.0, jitter, EVEN.size)
    samples = decay(EVEN if sampled == "evenly" else instants)
    record = read(tmp_path, [f"{t:.9f}" for t in instants], samples)
    true = decay(record.time if sampled == "unevenly" else EVEN)
    assert ("less noise at equal ones" in record.remarks[0]) == (sampled == "evenly")
    assert record.sample_rate_hz == pytest.approx(RATE, rel=1e-4)
    assert np.std(record.outputs.T[50:-50] - true[50:-50]) < 5e-3


@pytest.mark.parametrize("jitter", [0.0, 100e-6])
def test_a_missing_row_is_refused_wherever_it_is(tmp_path, jitter):
    """By the last bit of a difference it was filled instead in half of the places."""
    instants = np.arange(400) / RATE + np.random.default_rng(0).uniform(0.0, jitter, 400)
    for missing in range(30, 380, 50):
        times = [f"{t:.6f}" for t in np.delete(instants, missing)]
        with pytest.raises(RecordFileError, match=f"row {missing + 2} comes 0.00(2|19|18|21)"):
            read(tmp_path, times)


@pytest.mark.parametrize(("unit", "per_second"), [("ms", 1e3), ("us", 1e6)])
def test_a_unix_time_is_in_the_unit_that_its_size_tells(tmp_path, unit, per_second):
    times = [f"{1714730000 * per_second + per_second * t:.0f}" for t in EVEN]
    record = read(tmp_path, times, name="timestamp")
    assert record.sample_rate_hz == pytest.approx(RATE) and record.start_time == 0.0
    assert f"taken as {unit} since 1970" in record.remarks[0]


def test_seconds_are_said_where_they_are_assumed(tmp_path):
    plain = [f"{t:.3f}" for t in EVEN]
    assert read(tmp_path, plain, name="Time").remarks == ("Time states no unit: taken as s",)
    assert read(tmp_path, plain, name="Time (s)").remarks == read(tmp_path, plain, name="Zeit in s").remarks == ()
    np.savez(tmp_path / "x.npz", t=EVEN, a=EVEN)
    assert read_record(tmp_path / "x.npz").remarks == ("t states no unit: taken as s",)


def test_an_arduinos_clocks_are_times(tmp_path):
    for name, per_second in (("micros", 1e6), ("millis", 1e3)):
        record = read(tmp_path, [f"{per_second * t:.0f}" for t in EVEN], name=name)
        assert record.sample_rate_hz == pytest.approx(RATE) and record.n_outputs == 2


def test_a_row_is_that_of_the_file(tmp_path):
    rows = [f"{t:.3f},{k}" for k, t in enumerate(EVEN[:60])]
    head = ["Logger X", "", "Serial 123", "Time (s),a"]
    for changed, words in (
        ([*rows[:40], "0.040,NaN", *rows[41:]], "row 46: nan"),
        ([*rows[:40], *rows[41:]], "row 46 comes"),
    ):
        lines = [*head, *changed[:10], "# a comment", *changed[10:]]
        (tmp_path / "x.csv").write_text("\n".join(lines) + "\n")
        with pytest.raises(RecordFileError, match=words):
            read_record(tmp_path / "x.csv")


def test_an_axis_of_unknown_name_is_no_reason_to_state_a_rate(tmp_path):
    """A rate beside it would make a signal of the clock, or a record of FRFs."""
    with pytest.raises(RecordFileError, match=r"unless 'Speed', which rises all along, is one: call it time \[s\]"):
        read(tmp_path, [f"{t:.3f}" for t in EVEN], name="Speed")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda rows: rows[::-1], "its instants decrease, from 0.059 to 0 s; sort the rows by time"),
        (
            lambda rows: [*rows[:30], rows[31], rows[30], *rows[32:]],
            "row 33 is 0.001 s before the one above; sort the rows",
        ),
        (
            lambda rows: [*rows[1::2], *rows[::2]],
            "row 32 is 0.059 s before .*; sort the rows by time, or cut the record there",
        ),
        (
            lambda rows: [*rows[:30], rows[29], *rows[30:]],
            "row 32 has the instant .*, 0.029 s; remove the doubled row$",
        ),
        (lambda rows: [rows[7]] * 60, "all its instants are equal, 0.007 s"),
        (lambda rows: [*rows[:30], *rows[40:]], "row 32 comes 0.011 s after .* fill the gap, or cut the record there"),
    ],
)
def test_instants_that_are_no_time_are_told_with_their_remedy(tmp_path, change, words):
    rows = change([f"{t:.3f},{k % 7}" for k, t in enumerate(EVEN[:60])])
    (tmp_path / "x.csv").write_text("t [s],a\n" + "\n".join(rows) + "\n")
    with pytest.raises(RecordFileError, match="is not uniformly sampled: .*" + words):
        read_record(tmp_path / "x.csv")
