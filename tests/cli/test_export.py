"""`workbench export`: a controller of a case as a file, and one line where it cannot be."""

import runpy

import pytest

RIG = """
[structure]
kind = "beam"
length = 2.0
mass_per_length = 1.0
bending_stiffness = 4.0
left = "hinged"
right = "hinged"
damping_ratio = 0.01
modes = 5
[[input]]
name = "F1"
kind = "actuator"
at = 0.45
[[output]]
name = "d1"
quantity = "displacement"
at = 0.3
noise_std = 0.001
[[output]]
name = "a1"
quantity = "acceleration"
at = 0.3
noise_std = 0.001
"""


@pytest.fixture
def rig(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    return path


@pytest.mark.parametrize("estimator", ["luenberger", "kalman"])
def test_a_controller_of_a_case_is_written(run, rig, tmp_path, estimator):
    result = run("export", rig, "--rate-hz", 100, "--estimator", estimator, "--to", tmp_path / "one.py")
    assert result.exit_code == 0, result.output
    assert "phase lag" in result.output and "decay rate" in result.output
    assert "not used (accelerations): a1" in result.output
    one = runpy.run_path(str(tmp_path / "one.py"))["Controller"]()
    assert [one.step([1.0]), one.step([0.0])] != [[0.0], [0.0]]


def test_a_rigid_mode_that_nothing_holds_is_told(run, rig, tmp_path):
    """Rounding of its pole is no decay rate."""
    rig.write_text(
        RIG.replace('right = "hinged"', 'right = "free"').replace("damping_ratio = 0.01", "damping_ratio = 0.1")
    )
    result = run("export", rig, "--weight", 1e4, "--rate-hz", 100, "--to", tmp_path / "one.py")
    said = " ".join(result.output.split())
    assert "decay rate 0 1/s, 0 1/s in continuous time" in said, said
    assert "no gain acts on the displacement of the rigid mode(s) 1" in said and "none of rigid modes" in said


def test_a_kalman_filter_asks_for_the_noise_of_its_outputs(run, rig, tmp_path):
    rig.write_text(RIG.replace("noise_std = 0.001", "", 1))
    result = run("export", rig, "--rate-hz", 100, "--estimator", "kalman", "--to", tmp_path / "one.py")
    assert result.exit_code == 2 and "noise_std of d1 is 0" in " ".join(result.stderr.split())


def test_a_controller_is_told_in_the_units_of_the_case(run, rig, tmp_path):
    rig.write_text(RIG + '[units]\nlength = "mm"\nmass = "t"\ntime = "s"\nforce = "N"\n')
    assert run("export", rig, "--rate-hz", 100, "--to", tmp_path / "one.c").exit_code == 0
    header = (tmp_path / "one.h").read_text()
    for told in ("displacement at x = 0.3, mm", "force at x = 0.45, N", "displacement of mode 1, t^0.5 mm"):
        assert told in header


def test_rates_and_delays_of_a_controller_are_in_the_units_of_time_of_the_case(run, rig, tmp_path):
    """The same numbers of a case in seconds and of one in milliseconds."""
    said = {}
    for time, names in {"s": "", "ms": '[units]\nlength = "m"\nmass = "kg"\ntime = "ms"\nforce = "MN"\n'}.items():
        rig.write_text(RIG + names)
        said[time] = run("export", rig, "--rate-hz", 100, "--to", tmp_path / f"{time}.py").output
    assert "at 100 Hz" in said["s"] and "frequency [Hz]" in said["s"] and " ms\n" in said["s"]
    assert "at 100 1/ms" in said["ms"] and "frequency [1/ms]" in said["ms"]
    assert " Hz" not in said["ms"] and "1/s" not in said["ms"]


@pytest.mark.parametrize(("law", "asked"), [("poles", 0.3), ("imsc", 0.7)])
def test_the_damping_that_a_law_gives_is_told(run, rig, tmp_path, law, asked):
    """With R = 1 / (2 ζ² ω²) of IMSC and x² = 1 + 2 ζ²: 4 ζ_c² x = 4 ζ_0² + 2 ζ² + 2 (x - 1) (near ζ)."""
    given = asked
    if law == "imsc":
        x = (1 + 2 * asked**2) ** 0.5
        given = ((4 * 0.02**2 + 2 * asked**2 + 2 * (x - 1)) / (4 * x)) ** 0.5
    rig.write_text(RIG.replace("damping_ratio = 0.01", "damping_ratio = 0.02"))
    options = ("--law", law, "--damping", asked, "--rate-hz", 1000, "--to", tmp_path / "one.py")
    result = run("export", rig, "--controlled-modes", 1, *options)
    assert f"with exact modal coordinates: {100 * given:.3g} %\n" in result.output, result.output


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--rate-hz", "1"], "1 Hz is too slow for mode 1"),
        (["--rate-hz", "-5"], "--rate-hz is the sample rate of the controller, above 0 Hz; got -5"),
        (["--rate-hz", "0"], "above 0 Hz; got 0"),
        (["--rate-hz", "100", "--law", "pid"], "no law is called 'pid'; the laws are imsc, coupled, poles, on-off"),
        (["--rate-hz", "100", "--law", "poles", "--weight", "2"], "give --damping for poles"),
        (["--rate-hz", "100", "--law", "on-off"], "is exported by `workbench redesign --to`"),
        (["--rate-hz", "100", "--weight", "2", "--damping", "0.1"], "give one of them"),
        (["--rate-hz", "100", "--law", "on-off", "--damping", "0.1"], "on-off control gives no damping ratio"),
        (["--rate-hz", "100", "--estimator", "pid"], "--estimator is one of luenberger, kalman"),
        (["--rate-hz", "100", "--to", "one.txt"], "written as .c, .py or .mat"),
        (["--rate-hz", "100", "--to", "nowhere/one.c"], "there is no folder nowhere"),
    ],
)
def test_what_cannot_be_exported_is_said_in_one_line(run, rig, tmp_path, monkeypatch, options, said):
    monkeypatch.chdir(tmp_path)
    result = run("export", rig, "--to", "one.c", *options)
    assert result.exit_code == 2
    assert said in " ".join(result.stderr.split()) and len(result.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "one.c").exists()
