"""The public names: typed, documented, quick to import, and reachable under their earlier names."""

import re
import subprocess
import sys
import warnings
from importlib import import_module
from pathlib import Path

import pytest
from mypy import api

import workbench as wb

ROOT = Path(wb.__file__).parents[1]


@pytest.mark.skipif(not (ROOT / ".mypy_cache").is_dir(), reason="types are checked after `make lint`, in a second")
def test_a_type_checker_knows_every_public_name(tmp_path, monkeypatch):
    program = tmp_path / "program.py"
    program.write_text("\n".join(["import workbench as wb", *(f"reveal_type(wb.{name})" for name in wb.__all__)]))
    monkeypatch.setenv("MYPYPATH", str(ROOT))
    cache = str(ROOT / ".mypy_cache")  # that `make lint` leaves
    said, trouble, _ = api.run(["--config-file", str(ROOT / "pyproject.toml"), "--cache-dir", cache, str(program)])
    types = re.findall(r'Revealed type is "(.*)"', said)
    assert len(types) == len(wb.__all__), said + trouble
    assert not [name for name, told in zip(wb.__all__, types, strict=True) if told == "Any"]


def test_the_package_says_that_it_is_typed():
    assert (ROOT / "workbench" / "py.typed").is_file()


def test_the_core_is_small():
    assert len(wb.__all__) <= 80


def test_every_public_name_is_documented():
    bare = [name for name in wb.__all__ if name != "CATALOGUE" and not getattr(wb, name).__doc__]
    assert not bare


@pytest.mark.parametrize(("old", "new"), wb.RENAMED.items())
def test_a_name_of_an_earlier_version_works_and_says_the_new_one(old, new):
    room, _, name = f"workbench.{new}".rpartition(".")
    with pytest.warns(DeprecationWarning, match=re.escape(f"{room}.{name}")):
        found = getattr(wb, old)
    assert found is getattr(import_module(room), name)
    assert old not in wb.__all__


def test_a_wrong_name_is_refused():
    with pytest.raises(AttributeError, match="Baem"):
        _ = wb.Baem


def test_public_names_come_without_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        for name in wb.__all__:
            getattr(wb, name)


def test_the_package_is_imported_in_a_fraction_of_the_time_of_control():
    def seconds(module: str) -> float:
        program = f"import time; start = time.process_time(); import {module}; print(time.process_time() - start)"
        return float(subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stdout)

    assert min(seconds("workbench") for _ in range(3)) < 0.3 * seconds("control")
