"""The constants of the searches outside `gap/search` stand in frozen settings, and each is read."""

import re
from dataclasses import FrozenInstanceError, fields, is_dataclass
from importlib import import_module
from pathlib import Path

import pytest

import workbench

ROOT = Path(workbench.__file__).parent
ROOMS = ("identification", "gap/localisation", "gap/prediction")


def settings_of(room):
    """(module, name, settings) of every settings object of a room, where it is made."""
    for path in sorted((ROOT / room).rglob("*.py")):
        module = f"workbench.{path.relative_to(ROOT).with_suffix('').as_posix().replace('/', '.')}"
        for name, held in vars(import_module(module)).items():
            if is_dataclass(held) and type(held).__name__.endswith("Settings") and type(held).__module__ == module:
                yield module, name, held


@pytest.mark.parametrize("room", ROOMS)
def test_every_constant_is_read_and_frozen(room):
    sources = {path: path.read_text(encoding="utf-8") for path in (ROOT / room).rglob("*.py")}
    read = set(re.findall(r"\b([A-Z_]+)\.([a-z_]+)\b", "\n".join(sources.values())))
    there = list(settings_of(room))
    assert there
    for module, name, held in there:
        for field in fields(held):
            assert (name, field.name) in read, f"{module}: no step reads {name}.{field.name}"
            with pytest.raises(FrozenInstanceError):
                setattr(held, field.name, 0)
