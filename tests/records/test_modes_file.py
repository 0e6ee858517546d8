"""Modes written by pyuff, by hand as the format has them, and as arrays, read back."""

import h5py
import numpy as np
import pytest
import pyuff
from scipy.io import savemat

from workbench.records.limits import RecordFileError
from workbench.records.modes_file import read_modes

FREQUENCIES, DAMPING, MASSES = np.array([11.5, 23.25]), np.array([0.01, 0.02]), np.array([4.0, 0.25])
PLACES = {7: (0.0, 0.0, 0.5), 9: (1.0, 0.5, 0.5)}
SHAPES = np.array([[0.5, -1.0], [2.0, 0.25]])  # of nodes 7 and 9 along z


def write_55(path, *, masses=MASSES, analysis=2, places=PLACES, shapes=SHAPES, also=(), **changed):
    file = pyuff.UFF(str(path))
    nodes = np.array([*PLACES])
    x, y, z = np.array([*places.values()]).T
    blank = np.zeros(2, int)
    file.write_sets(
        {"type": 2411, "node_nums": nodes, "def_cs": blank, "disp_cs": blank, "color": blank, "x": x, "y": y, "z": z},
        "overwrite",
    )
    for r in range(2):
        entry = {
            "type": 55, "id1": "a", "id2": "b", "id3": "c", "id4": "d", "id5": "e", "model_type": 1,
            "analysis_type": analysis, "data_ch": 2, "spec_data_type": 8, "data_type": 2, "n_data_per_node": 3,
            "load_case": 1, "mode_n": r + 1, "freq": FREQUENCIES[r], "modal_m": masses[r],
            "modal_damp_vis": DAMPING[r], "modal_damp_his": 0.0, "node_nums": nodes,
            "r1": np.zeros(2), "r2": np.zeros(2), "r3": shapes[:, r], **changed,
        }  # fmt: skip
        file.write_sets([*also, entry], "add")
    return path


def write_2414(path):
    """As records 1 to 15 of the format's own description have them."""
    lines = ["    -1", "  2411"]
    for node, place in PLACES.items():
        lines += [f"{node:10d}{0:10d}{0:10d}{0:10d}", "".join(f"{v:25.16E}" for v in place)]
    lines.append("    -1")
    for r in range(2):
        lines += ["    -1", "  2414", f"{r + 1:10d}", "modes", f"{1:10d}", *["NONE"] * 5]
        lines += ["".join(f"{v:10d}" for v in (1, 2, 2, 8, 2, 3))]
        lines += ["".join(f"{v:10d}" for v in (0, 0, 1, 0, 1, r + 1, 0, 0)), f"{0:10d}{0:10d}"]
        figures = (0.0, FREQUENCIES[r], (2 * np.pi * FREQUENCIES[r]) ** 2, MASSES[r], DAMPING[r], 0.0)
        lines += ["".join(f"{v:13.5E}" for v in figures), "".join(f"{0.0:13.5E}" for _ in range(6))]
        for node, value in zip(PLACES, SHAPES[:, r]):
            lines += [f"{node:10d}", "".join(f"{v:13.5E}" for v in (0.0, 0.0, value))]
        lines.append("    -1")
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("n_points", [2, 3])
def test_arrays_of_matlab_7_3_have_their_axes_in_order(tmp_path, n_points):
    """Shapes were read transposed: refused, and where points are as many as modes, taken so."""
    shapes = np.random.default_rng(0).standard_normal((n_points, 2))
    arrays = {"shapes": shapes, "frequencies_hz": FREQUENCIES[:, None], "positions": np.eye(n_points, 3)}
    with h5py.File(tmp_path / "modes.mat", "w") as file:
        for name, values in arrays.items():
            file.create_dataset(name, data=values.T).attrs["MATLAB_class"] = np.bytes_("double")
    modes = read_modes(tmp_path / "modes.mat")
    np.testing.assert_array_equal(modes.phi(modes.domain.names), shapes)


@pytest.mark.parametrize("write", [write_55, write_2414])
def test_universal_files_of_modes_are_read_and_scaled(tmp_path, write):
    modes = read_modes(write(tmp_path / "modes.unv"))
    np.testing.assert_allclose(modes.frequencies_hz, FREQUENCIES, rtol=1e-5)
    np.testing.assert_allclose(modes.zeta, DAMPING, rtol=1e-9)
    assert modes.domain.names == ("7z", "9z") and modes.domain.directions == ("z", "z")
    np.testing.assert_allclose(modes.domain.positions, [*PLACES.values()])
    np.testing.assert_allclose(modes.phi(["7z", "9z"]), SHAPES / np.sqrt(MASSES), rtol=1e-5)
    np.testing.assert_allclose(modes.phi(["9"], direction="z"), SHAPES[1:] / np.sqrt(MASSES), rtol=1e-5)


def test_a_universal_file_is_read_in_the_units_that_it_states(tmp_path):
    """In mm, N and t: 2 kg are 0.002 t, and a shape that turns by 0.1 rad a millimetre turns by 100 rad a metre."""
    units = {"type": 164, "units_code": 9, "temp_mode": 1, "length": 1000.0, "force": 1.0, "temp": 1.0,
             "temp_offset": 0.0}  # fmt: skip
    millimetres = {node: tuple(1000.0 * v for v in place) for node, place in PLACES.items()}
    turning = {"n_data_per_node": 6, "data_ch": 3, "r4": np.full(2, 0.1), "r5": np.zeros(2), "r6": np.zeros(2)}
    path = write_55(tmp_path / "m.unv", masses=0.001 * MASSES, places=millimetres, also=[units], **turning)
    modes = read_modes(path)
    np.testing.assert_allclose(modes.domain.positions[::2], [*PLACES.values()])
    np.testing.assert_allclose(modes.phi(["7z", "9z"]), SHAPES / np.sqrt(MASSES), rtol=1e-5)
    np.testing.assert_allclose(modes.phi(["7rx"])[0], 100.0 / np.sqrt(MASSES), rtol=1e-5)


def test_only_displacements_of_a_universal_file_are_shapes(tmp_path):
    path = write_55(tmp_path / "m.unv")
    for r in range(2):  # the reactions of each mode, as a finite-element program writes them beside its shape
        reactions = {**pyuff.UFF(str(path)).read_sets(1 + r), "spec_data_type": 9}
        pyuff.UFF(str(path)).write_sets(reactions, "add")
    np.testing.assert_allclose(read_modes(path).frequencies_hz, FREQUENCIES, rtol=1e-5)
    with pytest.raises(RecordFileError, match="holds no displacements of normal modes at nodes"):
        read_modes(write_55(tmp_path / "forces.unv", spec_data_type=9))


@pytest.mark.parametrize(
    "changed, message",
    [
        ({"shapes": SHAPES * (1 + 0.2j), "r1": np.zeros(2) * 1j, "r2": np.zeros(2) * 1j, "data_type": 5},
         "its shapes are complex"),
        ({"shapes": np.where(SHAPES == 2.0, np.nan, SHAPES)}, "shapes must be finite; of mode 1 row 2 is nan"),
        ({"also": [{"type": 15, "node_nums": [9], "def_cs": [0], "disp_cs": [0], "color": [0], "x": [1.0], "y": [0.5],
                    "z": [0.6]}]}, "node 9 has two positions"),
    ],
)  # fmt: skip
def test_what_a_universal_file_contradicts_is_refused(tmp_path, changed, message):
    with pytest.raises(RecordFileError, match=message):
        read_modes(write_55(tmp_path / "m.unv", **changed))


def arrays(**more):
    return {"shapes": SHAPES, "frequencies_hz": FREQUENCIES, **more}


def write_arrays(path, values):
    if path.suffix == ".npz":
        np.savez(path, **values)
    elif path.suffix == ".mat":
        savemat(path, values)
    else:
        with h5py.File(path, "w") as file:
            for name, array in values.items():
                file[name] = array
    return path


@pytest.mark.parametrize("ending", [".npz", ".mat", ".h5"])
def test_arrays_are_read_from_every_format(tmp_path, ending):
    path = write_arrays(tmp_path / f"modes{ending}", arrays(modal_mass=MASSES, positions=np.array([*PLACES.values()])))
    modes = read_modes(path, damping_ratios=0.03)
    np.testing.assert_allclose(modes.phi(["1", "2"]), SHAPES / np.sqrt(MASSES))
    np.testing.assert_allclose(modes.zeta, 0.03)
    np.testing.assert_allclose(modes.domain.positions, [*PLACES.values()])


@pytest.mark.parametrize("kind", ["S", object])
def test_names_of_points_are_read_from_hdf5(tmp_path, kind):
    text = {"names": np.array(["top", "low"]).astype(kind), "directions": np.array(["x", "y"]).astype(kind)}
    domain = read_modes(write_arrays(tmp_path / "m.h5", arrays(**text))).domain
    assert domain.names == ("top", "low") and domain.directions == ("x", "y")


def test_names_of_points_are_kept_and_modes_put_in_order(tmp_path):
    values = arrays(names=np.array(["F1.4y", "F2.4y"]), directions=np.array(["y", "y"]))
    values |= {"frequencies_hz": FREQUENCIES[::-1], "shapes": SHAPES[:, ::-1]}
    modes = read_modes(write_arrays(tmp_path / "m.npz", values))
    np.testing.assert_allclose(modes.phi("F2.4y"), SHAPES[1:])
    np.testing.assert_allclose(modes.frequencies_hz, FREQUENCIES)


def test_a_mass_matrix_scales_the_modes_and_shows_what_does_not_belong_to_them(tmp_path):
    vectors = np.linalg.eigh(np.array([[2.0, 1.0], [1.0, 3.0]]))[1] * [3.0, 0.5]
    found = read_modes(write_arrays(tmp_path / "a.npz", arrays(shapes=vectors, mass_matrix=2.0 * np.eye(2))))
    np.testing.assert_allclose(2.0 * found.phi(["1", "2"]).T @ found.phi(["1", "2"]), np.eye(2), atol=1e-12)
    with pytest.raises(RecordFileError, match=r"modes 1 and 2 are not orthogonal.*0\.\d+ of"):
        read_modes(write_arrays(tmp_path / "b.npz", arrays(mass_matrix=np.diag([1.0, 2.0]))))


def test_shapes_that_are_stated_as_mass_normalised_and_are_not_are_refused_with_their_modal_mass(tmp_path):
    vectors = np.linalg.eigh(np.array([[2.0, 1.0], [1.0, 3.0]]))[1] * [1.0, 1.5]
    path = write_arrays(tmp_path / "a.npz", arrays(shapes=vectors, mass_matrix=np.eye(2)))
    with pytest.raises(RecordFileError, match=r"mode 2 has a modal mass .* of 2.25 kg .* and 1 kg is stated.* 1.5 tim"):
        read_modes(path, modal_mass=1.0)
    read_modes(path, modal_mass=[1.0, 2.25])


@pytest.mark.parametrize(
    "values, message",
    [
        ({"shapes": SHAPES}, "needs `shapes`.*it holds shapes"),
        (arrays(shapes=SHAPES * 1j), "complex"),
        (arrays(shapes=SHAPES * np.nan), "m.npz: shapes must be finite; of mode 1 row 1 is nan"),
        (arrays(frequencies_hz=np.array(["3 Hz", "8 Hz"])), "m.npz: could not convert string to float"),
        (arrays(damping_ratios=np.array([0.5, 2.0])), "must be finite and below 1; of mode 2 it is 2: .* not per cent"),
        (arrays(modal_mass=np.array([1.0, -2.0])), "modal_mass must be positive, kg; of mode 2 it is -2"),
        (arrays(frequencies_hz=np.ones(3)), r"with 3 modes; it is \(2, 2\)"),
        (arrays(names=np.array(["a"])), "2 rows of shapes need as many points; it names 1"),
        (arrays(names=np.array(["a", "a"])), "'a' twice"),
        (arrays(omega=np.ones(2)), "holds both `frequencies_hz` and `omega`"),
        (arrays(mass=np.eye(2)), "an array 'mass' is not known; name it mass_matrix or modal_mass"),
        (arrays(modal_masses=np.ones(2)), "an array 'modal_masses' is not known; name it modal_mass if it is that"),
        (arrays(mass_matrix=np.eye(3)), r"mass matrix of 2 points must be finite, \(2, 2\); it is \(3, 3\)"),
        (arrays(mass_matrix=np.full((2, 2), np.nan)), "it is not finite"),
        (arrays(mass_matrix=-np.eye(2)), "mass matrix is not positive definite: mode 1 has a modal mass of -"),
    ],
)
def test_a_file_that_is_no_set_of_modes_is_refused(tmp_path, values, message):
    with pytest.raises(RecordFileError, match=message):
        read_modes(write_arrays(tmp_path / "m.npz", values))


def test_what_a_universal_file_cannot_say_is_asked_for(tmp_path):
    path = write_55(tmp_path / "m.uff", masses=np.zeros(2))
    with pytest.raises(RecordFileError, match=r"no modal mass of mode 1.*modal_mass="):
        read_modes(path)
    np.testing.assert_allclose(read_modes(path, modal_mass=1.0).phi("7z"), SHAPES[:1], rtol=1e-5)
    with pytest.raises(RecordFileError, match="pyNastran"):
        read_modes(tmp_path / "m.op2")
    with pytest.raises(RecordFileError, match="names no format of modes"):
        read_modes(tmp_path / "m.csv")


@pytest.mark.parametrize(
    ("changed", "given", "message"),
    [
        ({}, {"modal_mass": [1.0, 2.0]}, "modal_mass is one number, or one per mode: 3 modes need as many; got 2"),
        ({}, {"damping_ratios": [0.01] * 4}, "damping_ratios is one number, or one per mode: .* got 4"),
        ({"frequencies_hz": [3.0, -5.0, 8.0]}, {}, "frequencies_hz must be .* not negative; of mode 2 it is -5;"),
        ({"frequencies_hz": [3.0, 5.0, np.nan]}, {}, "of mode 3 it is nan"),
    ],
)
def test_numbers_of_modes_that_do_not_fit_are_named_with_the_file(tmp_path, changed, given, message):
    path = tmp_path / "model.npz"
    np.savez(path, **{"shapes": np.eye(4)[:, :3], "frequencies_hz": [3.0, 5.0, 8.0], **changed})
    with pytest.raises(RecordFileError, match=f"model.npz: .*{message}"):
        read_modes(path, **given)
