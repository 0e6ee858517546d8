"""Many cases: in order, once each, kept when done, errors beside results; a table that reads back bit for bit."""

import csv
import json
import os
from pathlib import Path

import numpy as np
import pytest

from workbench import study
from workbench.study.runs.cache import decoded, encoded, read_record, write_record
from workbench.study.runs.cases import StudyError

HERE = {"workers": 1}


def told(path, **parameters):
    """A function that leaves a mark each time it is called."""
    with open(path, "a") as file:
        file.write("x")


def counted(at, log):
    told(log)
    return {"square": at**2, "row": np.arange(3) / 7}


def fails_at_two(at):
    if at == 2:
        raise ArithmeticError(f"no {at}")
    return at / 3


def third(at):
    return {"third": at / 3}


def dies_at_two(at):
    if at == 2:
        os._exit(9)
    return at / 3


def drawn(at, seed):
    return np.random.default_rng(seed).normal() + at


def calls(log) -> int:
    return len(log.read_text())


def test_results_come_in_the_order_of_the_cases_and_from_the_cache_the_second_time(tmp_path):
    log, shares = tmp_path / "log", []
    cases = study.grid(at=(3, 1, 2), log=[str(log)])
    first = study.run(cases, counted, cache=tmp_path, report=lambda text, share: shares.append(share), **HERE)
    again = study.run(cases[::-1], counted, cache=tmp_path, **HERE)
    assert [r["square"] for r in first] == [9, 1, 4] and [r["square"] for r in again] == [4, 1, 9]
    assert calls(log) == 3 and shares == [0, 1 / 3, 2 / 3, 1]
    assert (first[0]["row"] == np.arange(3) / 7).all() and first[0]["row"].tobytes() == again[2]["row"].tobytes()
    study.run([*cases, {"at": 1.0, "log": str(log)}], counted, cache=tmp_path, **HERE)
    assert calls(log) == 4  # 1 and 1.0 may mean different things to a function


def test_equal_cases_are_worked_once(tmp_path):
    log = tmp_path / "log"
    found = study.run([{"at": 2, "log": str(log)}] * 3, counted, cache=tmp_path, **HERE)
    assert len(found) == 3 and calls(log) == 1


def test_a_file_named_by_a_path_counts_with_what_it_holds(tmp_path):
    def size(file):
        return len(file.read_text())

    data = tmp_path / "data.txt"
    data.write_text("abc")
    assert study.run([{"file": data}], size, cache=tmp_path / "c", **HERE)[0]["result"] == 3
    data.write_text("abcd")
    assert study.run([{"file": data}], size, cache=tmp_path / "c", **HERE)[0]["result"] == 4


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_is_kept_beside_the_results_of_the_others(tmp_path, workers):
    found = study.run(study.grid(at=range(4)), fails_at_two, cache=tmp_path, workers=workers)
    assert [r.error for r in found] == [None, None, "ArithmeticError: no 2", None]
    assert "fails_at_two" in found.failed[0].trace and found[3]["result"] == 1.0
    with pytest.raises(KeyError, match="no 2"):
        found[2]["result"]
    assert [row["error"] for row in found.rows()] == [None, None, "ArithmeticError: no 2", None]


def test_a_case_that_kills_its_process_takes_no_other_with_it(tmp_path):
    found = study.run(study.grid(at=range(8)), dies_at_two, cache=tmp_path, workers=2)
    assert [r["result"] for r in found if r.error is None] == [at / 3 for at in range(8) if at != 2]
    assert [r["at"] for r in found.failed] == [2] and "process died" in found[2].error


class Bomb:
    def __reduce__(self):
        return os._exit, (9,)


def test_processes_that_die_before_they_begin_end_the_run(tmp_path):
    bomb = Bomb()
    with pytest.raises(StudyError, match="before they began a case"):
        study.run(study.grid(at=range(3)), lambda at: (at, bomb), cache=None, workers=2)


def test_a_seed_belongs_to_its_case_and_not_to_the_order(tmp_path):
    cases = study.grid(at=range(5))
    first = study.run(cases, drawn, cache=None, **HERE)
    turned = study.run(cases[::-1], drawn, cache=None, **HERE)
    other = study.run(cases, drawn, cache=None, seed=1, **HERE)
    assert [r["result"] for r in first] == [r["result"] for r in turned][::-1]
    assert len({r.seed for r in (*first, *other)}) == 10
    assert study.run([{"at": 0, "seed": 5}], drawn, cache=None, **HERE)[0].seed == 5


@pytest.mark.parametrize(
    "damage", [lambda text: text[: len(text) // 2], lambda text: text.replace("9", "8"), str.upper]
)
def test_a_damaged_result_is_worked_again(tmp_path, damage):
    log = tmp_path / "log"
    cases = [{"at": 3, "log": str(log)}]
    study.run(cases, counted, cache=tmp_path / "c", **HERE)
    [file] = (tmp_path / "c").rglob("*.json")
    file.write_text(damage(file.read_text()))
    assert study.run(cases, counted, cache=tmp_path / "c", **HERE)[0]["square"] == 9 and calls(log) == 2


def test_a_write_that_is_cut_short_leaves_nothing(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    write_record(path, {"value": 1})
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        write_record(path, {"value": 2})
    assert read_record(path) == {"value": 1} and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "value",
    [np.nan, -0.0, 1e-320, np.inf, 2**70, True, None, "ü\n\ud800", [1, [2.5]], {"a": {"b": 1j}}, np.float32(0.1),
     np.arange(6).reshape(2, 3), np.array([1 + 2j]), np.array(3.5), np.zeros((0, 2)), np.array([True])],
)  # fmt: skip
def test_what_is_kept_comes_back_bit_for_bit(value, tmp_path):
    write_record(tmp_path / "a.json", {"v": encoded(value)})
    back = decoded(read_record(tmp_path / "a.json")["v"])
    if isinstance(value, np.ndarray):
        assert back.dtype == value.dtype and back.shape == value.shape and back.tobytes() == value.tobytes()
    else:
        assert repr(back) == repr(value.item() if isinstance(value, np.generic) else value)


def test_what_cannot_be_kept_is_that_cases_error():
    found = study.run([{}], lambda: {"figure": object()}, cache=None, **HERE)
    assert found[0].error.startswith("TypeError: the result['figure'] is a object")


@pytest.mark.parametrize(
    ("cases", "options", "words"),
    [
        ([], {}, "no cases"),
        ([3], {}, "case 1 must be a dict"),
        ([{"at": 1}, {"at": object()}], {}, "case 2, parameter 'at' is a object"),
        ([{"seconds": 1}], {}, "'seconds'"),
        ([{"at": 1}], {"workers": 0}, "workers must be at least 1; got 0"),
    ],
)
def test_what_cannot_be_a_case_is_refused(cases, options, words, tmp_path):
    with pytest.raises(StudyError, match=words):
        study.run(cases, fails_at_two, cache=tmp_path, **options)


def test_grids_and_samples():
    assert [tuple(case.values()) for case in study.grid(a=(1, 2), b="xy")] == [(1, "x"), (1, "y"), (2, "x"), (2, "y")]
    points = study.samples(20, seed=3, at=(2.0, 4.0), weight=(1.0, 10.0))
    at = np.sort([p["at"] for p in points])
    assert (np.floor((at - 2.0) * 10).astype(int) == np.arange(20)).all(), "one point in each twentieth"
    assert points == study.samples(20, seed=3, at=(2.0, 4.0), weight=(1.0, 10.0))
    with pytest.raises(StudyError, match="range of at must rise"):
        study.samples(2, at=(1.0, 1.0))


def table():
    def f(at, seed):
        if at == 2:
            raise ValueError("no, really")
        return {"third": at / 3, "nest": {"list": [1, at]}, "text": 'a "quoted", one'}

    return study.run(study.grid(at=(0.1, 2, 1e-300)), f, cache=None, **HERE)


def test_the_table_reads_back_bit_for_bit(tmp_path):
    found = table()
    with open(found.write(tmp_path / "t.csv"), newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["at", "third", "nest.list", "text", "seed", "error", "seconds", "versions"]
    assert [float(r["at"]) for r in rows] == [0.1, 2, 1e-300] and float(rows[2]["third"]) == 1e-300 / 3
    assert json.loads(rows[0]["nest.list"]) == [1, 0.1] and rows[0]["text"] == 'a "quoted", one'
    assert rows[1]["error"] == "ValueError: no, really" and rows[1]["third"] == ""
    assert [int(r["seed"]) for r in rows] == [r.seed for r in found] and "numpy" in rows[0]["versions"]


def test_the_table_as_a_frame_and_as_parquet(tmp_path):
    pd = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    found = table()
    frame = found.frame()
    back = pd.read_parquet(found.write(tmp_path / "t.parquet"))
    assert list(back.columns) == list(frame.columns) and back["third"][0] == 0.1 / 3
    assert np.isnan(back["third"][1]) and list(back["nest.list"][2]) == [1, 1e-300]


def test_the_table_as_json_is_json(tmp_path):
    found = study.run([{"x": 1.0}], lambda x: {"y": np.inf, "z": [np.nan, x]}, cache=None, workers=1)
    [row] = json.loads(found.write(tmp_path / "t.json").read_text(), parse_constant=pytest.fail)
    assert row["y"] is None and row["z"] == [None, 1.0]


@pytest.mark.parametrize("ending", ["csv", "json"])
def test_rows_inside_a_table_hold_arrays_and_complex_numbers(ending, tmp_path):
    """Only those outside dicts were written; inside, the whole table was lost after its run."""
    found = study.run([{}], lambda: {"modes": [{"pole": -1 + 2j, "shape": np.arange(2)}]}, cache=None, **HERE)
    text = found.write(tmp_path / f"t.{ending}").read_text()
    [row] = json.loads(text) if ending == "json" else csv.DictReader(text.splitlines())
    modes = row["modes"] if ending == "json" else json.loads(row["modes"])
    assert modes == [{"pole": "(-1+2j)", "shape": [0, 1]}]


def test_a_table_says_what_it_cannot_do(tmp_path):
    with pytest.raises(StudyError, match=r"written as .csv, .parquet, .json; got .xls"):
        table().write(tmp_path / "t.xls")
    clash = study.run([{"at": 1}], lambda at: {"at": 2}, cache=None, **HERE)
    with pytest.raises(StudyError, match="'at' is a parameter and a result with different values"):
        clash.rows()
    twice = study.run([{}], lambda: {"a.b": 1, "a": {"b": 2}}, cache=None, **HERE)
    with pytest.raises(StudyError, match=r"the same column name 'a.b'"):
        twice.rows()
    for name in ("error", "seconds", "versions", "seed"):
        found = study.run([{}], lambda name=name: {name: 0.1}, cache=None, **HERE)
        assert (
            found[0].error == f"TypeError: a result cannot be called {name!r}, a column of the results table; rename it"
        )
    assert not list(Path(tmp_path).iterdir())


def test_results_that_cannot_be_kept_are_not_lost(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("a file stands where the folder of the cache should be")
    with pytest.warns(UserWarning, match="3 of 3 results could not be written to"):
        found = study.run([{"at": at} for at in range(3)], third, cache=blocked, workers=1)
    assert [result["third"] for result in found] == [0.0, 1 / 3, 2 / 3] and not found.failed
