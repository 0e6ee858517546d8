"""`workbench look`: what a stranger's file holds, and a command that then works."""

import json
import shlex

import numpy as np
import pytest
from scipy.signal import firwin, lfilter

from workbench.cli.terminal import by_options, names_in
from workbench.records.files import write_record
from workbench.records.record import Channel, Record

RATE, N = 1000.0, 4000
OMEGA, ZETA = 2.0 * np.pi * 40.0, 0.01


def decay(rng):
    time = np.arange(N) / RATE
    return time, np.exp(-ZETA * OMEGA * time) * np.cos(OMEGA * time) + 1e-3 * rng.standard_normal(N)


def write(path, names, columns):
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=",".join(names), comments="")
    return path


def test_a_free_decay_is_shown_and_identified_by_the_command_it_offers(run, tmp_path):
    time, tip = decay(np.random.default_rng(0))
    path = write(tmp_path / "tip.csv", ["time", "tip", "spare"], [time, tip, np.full(N, 2.5)])
    seen = run("look", path, "--page", tmp_path / "p.html")
    assert seen.exit_code == 0, seen.output
    assert "2 outputs and 0 inputs, 4000 samples at 1000 Hz, 4 s from 0 s on" in seen.output
    [row] = [line.split() for line in seen.output.splitlines() if line.startswith("tip ")]
    assert abs(float(row[-1]) - 40.0) <= 1.0  # a line
    assert "'spare' stays at 2.5" in seen.output and (tmp_path / "p.html").is_file()
    [command] = [line.split("go on")[1] for line in seen.output.splitlines() if "go on" in line]
    words = shlex.split(command)
    assert words == ["workbench", "identify", str(path), "--outputs", "tip"]
    found = run(*words[1:])
    assert found.exit_code == 0 and "40.0" in found.output


def test_a_ring_down_that_is_far_from_over_is_one(run, tmp_path):
    """At the end it is still a third of what it was."""
    time = np.arange(4000) / 500.0
    rings = np.exp(-0.002 * 2 * np.pi * 12.3 * time) * np.sin(2 * np.pi * 12.3 * time)
    noisy = rings + 0.01 * np.random.default_rng(0).normal(size=time.size)
    path = write(tmp_path / "ring.csv", ["t", "a1", "a2"], [time, noisy, 0.4 * rings])
    assert "--ambient" not in run("look", path, "--page", tmp_path / "p.html").output


def test_a_folder_is_no_file_and_a_record_in_it_is_named(run, tmp_path):
    refused = run("look", tmp_path)
    assert refused.exit_code == 2 and "is a folder; give a file of .csv, .txt" in " ".join(refused.output.split())
    (tmp_path / "records").mkdir()
    (tmp_path / "case.toml").write_text("")
    time, tip = decay(np.random.default_rng(0))
    write(tmp_path / "records" / "tip.csv", ["time", "tip"], [time, tip])
    refused = " ".join(run("identify", tmp_path).output.split())
    assert "is a folder; give a file in it, such as" in refused and refused.endswith("records/tip.csv")


@pytest.mark.parametrize(("stored", "shown"), [("simulated", "tip"), ("by hand", "by hand")])
def test_a_record_that_nobody_named_is_shown_by_its_file(run, tmp_path, stored, shown):
    _, tip = decay(np.random.default_rng(0))
    record = Record(1.0 / RATE, tip[None], (Channel("tip", "displacement"),), name=stored)
    path, page = write_record(record, tmp_path / "tip.npz"), tmp_path / "p.html"
    assert run("look", path, "--page", page).exit_code == 0
    assert json.loads(page.with_suffix(".page.json").read_text())["blocks"][0]["figure"]["panels"][0]["title"] == shown
    assert run("identify", path, "--page", page).exit_code == 0
    captions = [block["caption"] for block in json.loads(page.with_suffix(".page.json").read_text())["blocks"]]
    assert f"Power spectral density of {shown}, by Welch's method." in captions


def test_ambient_identification_of_a_record_with_inputs_is_refused_with_the_option_to_leave_out(run, tmp_path):
    rng = np.random.default_rng(0)
    force, moves = rng.standard_normal((2, N))
    path = write(tmp_path / "driven.csv", ["t", "F", "a"], [np.arange(N) / RATE, force, moves])
    refused = run("identify", path, "--inputs", "F", "--ambient")
    said = " ".join(refused.output.split())
    assert refused.exit_code == 2
    assert "got 1 record with 1 input: leave --ambient out, to identify from the inputs" in said


@pytest.mark.slow
def test_an_input_is_known_by_its_name_or_unit_and_steady_motion_is_ambient(run, tmp_path):
    rng = np.random.default_rng(1)
    force, moves = rng.standard_normal((2, N))
    time = np.arange(N) / RATE
    driven = write(tmp_path / "driven.csv", ["t", "shaker force", "a1"], [time, force, moves])
    assert "--inputs 'shaker force'" in run("look", driven, "--page", tmp_path / "p.html").output
    kraft = write(tmp_path / "kraft.csv", ["t", "Kraft [N]", "Weg [m]"], [time, force, moves])
    assert "--inputs Kraft" in run("look", kraft, "--page", tmp_path / "p.html").output
    ambient = write(tmp_path / "ambient.csv", ["t", "a1", "a2"], [time, moves, force])
    assert "--ambient" in run("look", ambient, "--page", tmp_path / "p.html").output


def test_a_blow_that_rests_at_zero_is_an_input_without_fault(run, tmp_path):
    time = np.arange(N) / RATE
    blow = np.zeros(N)
    blow[10:14] = [3.0, 9.0, 8.0, 2.0]
    rings = np.convolve(blow, np.exp(-0.01 * 2 * np.pi * 12.3 * time) * np.sin(2 * np.pi * 12.3 * time))[:N]
    rings += 1e-3 * np.random.default_rng(0).normal(size=N)
    struck = write(tmp_path / "struck.csv", ["t", "force (N)", "a1"], [time, blow, rings])
    told = run("look", struck, "--page", tmp_path / "p.html").output
    assert told.startswith("1 output and 1 input") and "cut off" not in told
    assert "--inputs force" in told and "Frequency response functions" in (tmp_path / "p.html").read_text()


def test_a_clipped_blow_and_an_output_of_no_unit_are_said_before_modes_are(run, tmp_path):
    time, rng = np.arange(N) / RATE, np.random.default_rng(0)
    blow = np.zeros(N)
    blow[10:20] = np.minimum(9.0 * np.sin(np.pi * np.arange(10) / 10), 5.0)
    rings = np.convolve(blow, np.exp(-0.01 * 2 * np.pi * 12.3 * time) * np.sin(2 * np.pi * 12.3 * time))[:N]
    outputs = np.outer([1.0, 0.5], rings) + 1e-3 * rng.normal(size=(2, N))
    struck = write(tmp_path / "struck.csv", ["t", "force (N)", "a1 [m]", "a2"], [time, blow, *outputs])
    told = " ".join(run("look", struck, "--page", tmp_path / "p.html").output.split())
    assert "input 'force' is clipped at 5, 7 samples" in told and "'a2' states no quantity" in told
    assert "--inputs force --input-hold band-limited --outputs a1" in told
    found = run("identify", struck, "--inputs", "force", "--outputs", "a1")
    assert found.exit_code == 0 and "input 'force' is clipped at 5, 7 samples" in " ".join(found.output.split())
    refused = run("identify", struck, "--inputs", "force")
    assert refused.exit_code == 2 and "'a2' states no quantity" in " ".join(refused.output.split())


def test_units_stand_in_the_table_as_they_are_written(run, tmp_path):
    """A style of rich's begins like a unit in brackets, which was dropped."""
    path = write(
        tmp_path / "g.csv", ["time", "a [g]", "b [g]"], [np.arange(N) / RATE, *np.random.default_rng(0).random((2, N))]
    )
    seen = run("look", path, "--page", tmp_path / "p.html").output
    assert "a        acceleration [m/s^2]" in seen


def test_frfs_are_shown(run, tmp_path):
    lines = np.linspace(1.0, 100.0, 400)
    h = 1.0 / (OMEGA**2 - (2.0 * np.pi * lines) ** 2 + 2j * ZETA * OMEGA * 2.0 * np.pi * lines)
    np.savez(tmp_path / "frf.npz", frequency_hz=lines, H=h)
    seen = run("look", tmp_path / "frf.npz", "--page", tmp_path / "p.html")
    assert seen.exit_code == 0, seen.output
    assert "FRFs of 1 output and 1 input, 400 lines from 1 to 100 Hz" in seen.output
    [row] = [line.split() for line in seen.output.splitlines() if line.startswith("H")]
    assert abs(float(row[-1]) - 40.0) < 0.3


def test_what_cannot_be_read_ends_in_one_line(run, tmp_path):
    np.savez(tmp_path / "bare.npz", a=np.random.default_rng(0).standard_normal(100))
    bare = run("look", tmp_path / "bare.npz")
    assert bare.exit_code == 2 and "--sample-rate-hz" in bare.output and "sample_rate_hz" not in bare.output
    (tmp_path / "note.csv").write_text("hello\n")
    refused = run("look", tmp_path / "note.csv")
    assert refused.exit_code == 2 and len(refused.output.strip().splitlines()) == 1


def test_of_many_faults_of_a_kind_the_first_and_their_number_are_said(run, tmp_path):
    names = ["time", "a", *(f"d{j}" for j in range(30))]
    columns = [*decay(np.random.default_rng(0)), *np.ones((30, N))]
    seen = run("look", write(tmp_path / "many.csv", names, columns), "--page", tmp_path / "p.html")
    assert seen.output.count("the sensor is dead") == 24 and "6 more channels are dead" in seen.output


@pytest.mark.parametrize(("cut", "hold"), [(400.0, " --input-hold band-limited"), (None, "")])
def test_a_force_behind_an_anti_alias_filter_is_offered_as_band_limited(run, tmp_path, cut, hold):
    """Filtered at 20 times the rate by SciPy; as it would be held, `identify` calls it wrong."""
    fine = np.arange(20 * N) / (20 * RATE)
    blow = np.where(fine < 0.002, 100.0 * np.sin(np.pi * fine / 0.002).clip(0.0), 0.0)
    if cut:
        blow = lfilter(firwin(801, cut, fs=20 * RATE, window=("kaiser", 8.0)), 1.0, blow)
    force = blow[::20] + 0.01 * np.random.default_rng(0).normal(size=N)
    path = write(tmp_path / "struck.csv", ["t [s]", "hammer [N]", "tip [m]"], [fine[::20], force, np.cumsum(force)])
    told = run("look", path, "--page", tmp_path / "p.html").output
    assert told.split("--inputs hammer")[1].rstrip() == hold


def test_a_remark_on_an_argument_names_the_option():
    told = by_options("not as input_hold='zero' says; give input_hold='band-limited' or more `seconds`")
    assert told == "not as --input-hold zero says; give --input-hold band-limited or more --seconds"


@pytest.mark.parametrize("seconds", [0.3, 1.0])
def test_a_short_clean_decay_is_no_random_vibration(run, tmp_path, seconds):
    """Its level rises from one tenth of it to the next, as each holds a period of the slowest mode."""
    time = np.arange(0.0, seconds, 1 / RATE)
    modes = [np.exp(-z * w * time) * np.sin(w * time + 0.3) for w, z in ((75.4, 0.008), (472.5, 0.006), (1323, 0.005))]
    moves = np.array([[1.0, 0.8, 0.5], [2.0, -1.0, 1.0]]) @ modes
    moves += 1e-3 * np.random.default_rng(0).normal(size=moves.shape)
    path = write(tmp_path / "short.csv", ["t [s]", "a1", "a2"], [time, *moves])
    told = run("look", path, "--page", tmp_path / "p.html").output
    assert "go on    workbench identify" in told and "--ambient" not in told


def test_names_with_commas_are_offered_in_quotes_that_are_understood(run, tmp_path):
    time, tip = decay(np.random.default_rng(0))
    path = tmp_path / "comma.csv"
    rows = "".join(f"{t:.3f},{y:.6g},{2 * y + 0.01 * (k % 7):.6g},{k}\n" for k, (t, y) in enumerate(zip(time, tip)))
    path.write_text('t [s],"Acc 1, root [g]","5"" tip, Acc 2 [g]",n\n' + rows)
    told = run("look", path, "--page", tmp_path / "p.html").output
    words = shlex.split(told.split("go on")[1])
    assert names_in(words[-1]) == ("Acc 1, root", '5" tip, Acc 2')
    found = run(*words[1:])
    assert found.exit_code == 0 and "2 sensors" in found.output
    assert names_in("a, b,,c ") == ("a", "b", "c")


def test_an_acceleration_to_the_north_is_no_input(run, tmp_path):
    time, tip = decay(np.random.default_rng(0))
    path = write(tmp_path / "north.csv", ["t [s]", "Acc (N)", "Acc (E)"], [time, tip, np.roll(tip, 7)])
    told = run("look", path, "--page", tmp_path / "p.html").output
    assert "Acc: motions by name and forces by unit, so no inputs; does N mean north?" in told
    assert "--inputs" not in told


def test_a_sensor_that_reads_noise_alone_may_be_dead_and_one_that_moves_little_is_not(run, tmp_path):
    rng = np.random.default_rng(0)
    time, tip = decay(rng)
    columns = [time, tip, 0.5 * tip, 1e-6 * rng.standard_normal(N), 1e-5 * tip]
    path = write(tmp_path / "four.csv", ["t [s]", *(f"a{j} [m/s^2]" for j in (1, 2, 3, 4))], columns)
    told = " ".join(run("look", path, "--page", tmp_path / "p.html").output.split())
    assert "output 'a3' has 1e-06 rms and no spectral peak, beside" in told and told.count("may be dead") == 1
