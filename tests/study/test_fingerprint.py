"""A function is another one exactly when its result could be."""

import functools
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from workbench.rig.sensors import Sensor
from workbench.structure.member import Beam
from workbench.study.runs.cases import StudyError
from workbench.study.runs.fingerprint import fingerprint


class Node:
    """Equal to itself alone, so that sets can hold it."""


SOURCE = """
import numpy as np
from dataclasses import dataclass, field
from functools import cached_property

SCALE = 2.0

@dataclass(frozen=True, slots=True)
class Plate:
    depth: float = 0.1

@dataclass(frozen=True)
class Box:
    size: float = 3.0
    names: list = field(default_factory=list)
    sides: list = field(default_factory=lambda: [1.0])

    @cached_property
    def area(self):
        return self.size**2

    def volume(self):
        return self.size**3 * SCALE

def inner(x):
    return np.sin(x) + Box().volume() + Plate().depth

def unused(x):
    return 1

def function(x, power=2):
    '''Says something.'''
    # why
    return {"y": [inner(v) ** power for v in (x, 1.0)], "kind": x in {"a", "b", "c"}}
"""


def loaded(tmp_path, source, name="mine", registered=True):
    path = tmp_path / f"{name}.py"
    path.write_text(source)
    # bytecode of a source of the same size and second would be taken for its own
    Path(importlib.util.cache_from_source(path)).unlink(missing_ok=True)
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    if registered:
        sys.modules[name] = module
    spec.loader.exec_module(module)
    return module.function


def test_a_dataclass_of_a_module_that_is_not_registered_is_read(tmp_path):
    """As the modules of studies are; what `dataclass` writes for it belongs to no module."""
    assert fingerprint(loaded(tmp_path, SOURCE, name="study", registered=False))


@pytest.mark.parametrize(
    ("old", "new", "same"),
    [
        ("", "", True),
        ("# why", "# because\n    # of this", True),
        ("return 1", "return 2", True),
        ("return np.sin(x) +", "return np.cos(x) +", False),
        ("SCALE = 2.0", "SCALE = 2.5", False),
        ("SCALE = 2.0", "SCALE = 2", False),
        ("size: float = 3.0", "size: float = 4.0", False),
        ("default_factory=list", "default_factory=dict", False),
        ("lambda: [1.0]", "lambda: [2.0]", False),
        ("depth: float = 0.1", "depth: float = 0.2", False),
        ("self.size**2", "self.size**4", False),
        ("self.size**3", "self.size**2", False),
        ("power=2", "power=3", False),
        ("(x, 1.0)", "(x, 1.5)", False),
        ("import numpy as np", "import math as np", False),
    ],
)
def test_it_follows_what_the_function_reaches(tmp_path, old, new, same):
    first = fingerprint(loaded(tmp_path, SOURCE))
    assert (fingerprint(loaded(tmp_path, SOURCE.replace(old, new))) == first) is same


def test_it_follows_the_users_own_modules(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "helpers_of_mine.py").write_text("def help(x):\n    return x\n")
    for source in (
        "import helpers_of_mine\ndef function(x):\n    return helpers_of_mine.help(x)\n",
        "def function(x):\n    from helpers_of_mine import help\n    return help(x)\n",
    ):
        prints = []
        for body in ("return x", "return 2 * x"):
            (tmp_path / "helpers_of_mine.py").write_text(f"def help(x):\n    {body}\n")
            sys.modules.pop("helpers_of_mine", None)
            prints.append(fingerprint(loaded(tmp_path, source)))
        assert prints[0] != prints[1]


def test_it_follows_variables_of_modules_that_are_set_at_run_time(tmp_path, monkeypatch):
    """Read by the function itself, or by a function of the module that it calls; what nobody reads does not count."""
    monkeypatch.syspath_prepend(tmp_path)
    text = "GAIN, BIAS, UNREAD, RNG = 1.0, 1.0, 1.0, None\n\ndef biased(x):\n    return x + BIAS\n"
    (tmp_path / "settings_of_mine.py").write_text(text)
    source = "import settings_of_mine as s\ndef function(x):\n    return s.biased(s.GAIN * x), s.RNG\n"
    function = loaded(tmp_path, source)
    module = sys.modules["settings_of_mine"]
    first = fingerprint(function)
    for name, same in (("GAIN", False), ("BIAS", False), ("UNREAD", True)):
        monkeypatch.setattr(module, name, 2.0)
        assert (fingerprint(function) == first) is same
        monkeypatch.setattr(module, name, 1.0)
        assert fingerprint(function) == first
    monkeypatch.setattr(module, "RNG", np.random.default_rng(0))
    with pytest.raises(StudyError, match=r"settings_of_mine\.RNG is a random generator"):
        fingerprint(function)


def test_it_follows_closures_parts_and_methods():
    def outer(held):
        return lambda x: x * held

    assert fingerprint(outer(1.0)) == fingerprint(outer(1.0)) != fingerprint(outer(2.0))
    assert fingerprint(outer(np.ones(3))) != fingerprint(outer(np.ones((3, 1))))
    assert fingerprint(outer({"a": 1})) != fingerprint(outer({"a": 2}))
    plain = {"mass_per_length": 1.0, "bending_stiffness": 1.0, "left": "hinged", "right": "hinged"}
    beams = [Beam(length=length, **plain) for length in (1.0, 2.0, 1.0)]
    prints = [fingerprint(outer(beam)) for beam in beams]
    assert prints[0] == prints[2] != prints[1]
    modes = [beam.modes(3).select([0, 1]) for beam in beams]
    prints = [fingerprint(outer(m)) for m in modes]
    assert prints[0] == prints[2] != prints[1]
    assert fingerprint(functools.partial(outer, held=1)) != fingerprint(functools.partial(outer, held=2))
    assert fingerprint(functools.lru_cache(outer(1))) != fingerprint(functools.lru_cache(outer(2)))


def test_members_of_a_set_count_by_all_their_digits():
    def of(at):
        sensors = {Sensor("a", 0.5), Sensor("b", at)}
        return fingerprint(lambda: sensors)

    assert of(0.1) == of(0.1) != of(0.1 + 1e-12)


def test_a_member_of_a_set_may_lead_back_to_it():
    def of(number):
        node = Node()
        node.number, node.all = number, {node}
        return fingerprint(lambda: node.all)

    assert of(1) == of(1) != of(2)


@pytest.mark.slow
def test_it_is_the_same_in_every_process(tmp_path):
    loaded(tmp_path, SOURCE)
    script = (
        "import sys, importlib.util as u; s = u.spec_from_file_location('mine', sys.argv[1]);"
        "m = u.module_from_spec(s); sys.modules['mine'] = m; s.loader.exec_module(m);"
        "from workbench.study.runs.fingerprint import fingerprint; print(fingerprint(m.function))"
    )
    command = [sys.executable, "-c", script, tmp_path / "mine.py"]
    started = [
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONHASHSEED": seed})
        for seed in "12"
    ]
    first, second = (process.communicate()[0].strip() for process in started)
    assert first == second and len(first) == 40


def test_what_may_differ_from_run_to_run_is_refused(tmp_path):
    generator = np.random.default_rng(0)
    with pytest.raises(StudyError, match=r"generator, seen by .* is a random generator.*parameter `seed`"):
        fingerprint(lambda x: generator.normal())
    with open(tmp_path / "file", "w") as file, pytest.raises(StudyError, match=r"variable file, .* a TextIOWrapper"):
        fingerprint(lambda x: file.write(x))


def test_it_knows_its_own_source(monkeypatch):
    def function(x):
        return Beam

    from workbench.study.runs import versions

    first = fingerprint(function)
    versions.versions.cache_clear()
    monkeypatch.setattr(versions, "own_source", lambda: "edited")
    assert fingerprint(function) != first
    versions.versions.cache_clear()
