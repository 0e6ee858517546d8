"""The digest of everything besides its arguments that a function's result depends on: code, data and versions."""

import builtins
import dataclasses
import dis
import functools
import hashlib
import sys
import sysconfig
from collections.abc import Callable, Iterable, Iterator
from importlib import metadata, util
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

from workbench.study.runs.cases import StudyError
from workbench.study.runs.versions import PACKAGE, own_source, versions

LIBRARIES = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")})
PLAIN = (bool, int, float, complex, str, bytes, type(None), type(Ellipsis), range, slice)
OF_CLASS = {"__dict__", "__weakref__", "__module__", "__doc__", "__annotations__", "__firstlineno__"}


def fingerprint(function: Callable[..., Any]) -> str:
    """A digest that changes whenever the function's result could: 40 hex digits.

    The digest covers its byte code (without comments), defaults, closure and the globals it reads, and recursively the
    user's own functions, classes and modules; of the user's modules the file, and the present values of the names that
    the code reads. Installed libraries count by version, this package by its source.

    Raises:
        StudyError: the result depends on an object that may differ from run to run, such as a random generator.
    """
    walk = _Walk()
    walk.visit(function, getattr(function, "__qualname__", repr(function)))
    walk.visit_members()
    walk.visit(versions(), "versions")
    return walk.digest.hexdigest()[:40]


class _Walk:
    """Visits and hashes each object that a function refers to, directly or indirectly, once."""

    def __init__(self) -> None:
        self.digest = hashlib.sha256()
        self.seen: dict[int, tuple[int, object]] = {}  # keeps the objects alive, so that ids stay unique
        self.modules: dict[str, ModuleType] = {}  # the user's own
        self.names: set[str] = set()  # that code reads, of modules among others

    def add(self, *words: object) -> None:
        for word in words:
            word = word if isinstance(word, bytes) else str(word).encode()
            self.digest.update(f"{len(word)}:".encode() + word)

    def visit(self, value: Any, where: str) -> None:
        if isinstance(value, PLAIN) and type(value).__module__ == "builtins":
            return self.add(type(value).__name__, repr(value))
        if id(value) in self.seen:
            return self.add("again", self.seen[id(value)][0])
        self.seen[id(value)] = (len(self.seen), value)
        if isinstance(value, CodeType):
            return self._code(value, where)
        if isinstance(value, FunctionType):
            return self._function(value, where)
        if isinstance(value, MethodType):
            return self._each((value.__func__, value.__self__), where)
        if isinstance(value, functools.partial):
            return self._each((value.func, value.args, value.keywords), where)
        if isinstance(value, ModuleType):
            return self._module(value, where)
        if isinstance(value, type):
            return self._class(value, where)
        if isinstance(value, BuiltinFunctionType):
            return self.add("builtin", value.__module__, value.__qualname__)
        if isinstance(value, np.ndarray) and value.dtype != object:
            return self.add(value.dtype.str, value.shape, value.tobytes())
        if isinstance(value, dict):
            self.add("dict", len(value))
            return self._each([part for item in value.items() for part in item], where)
        if isinstance(value, list | tuple):
            self.add(type(value).__name__, len(value))
            return self._each(value, where)
        if isinstance(value, set | frozenset):
            return self.add("set", *sorted(self._of_member(member, where) for member in value))
        if isinstance(value, functools.cached_property):
            return self.visit(value.func, where)
        if callable(getattr(value, "__wrapped__", None)) or callable(getattr(value, "py_func", None)):
            self.add(type(value).__qualname__)  # a cache or a compiler around a function
            return self.visit(getattr(value, "__wrapped__", None) or value.py_func, where)
        return self._state(value, where)

    def visit_members(self) -> None:
        """Visit the values in the user's modules of all names that the code reads; they may be set at any time."""
        done: set[tuple[str, str]] = set()
        while True:
            held = {(at, name) for at, module in self.modules.items() for name in self.names & vars(module).keys()}
            if not held - done:
                return
            for at, name in sorted(held - done):
                self.add(at, name)
                self.visit(vars(self.modules[at])[name], f"{at}.{name}")
            done |= held

    def _of_member(self, value: object, where: str) -> str:
        """The hash of a member of a set, by which members are sorted; its repr may be rounded."""
        walk = _Walk()
        walk.modules, walk.names = self.modules, self.names
        walk.seen = dict(self.seen)  # a member may lead back to its set
        walk.visit(value, where)
        return walk.digest.hexdigest()

    def _each(self, values: Iterable[object], where: str) -> None:
        for value in values:
            self.visit(value, where)

    def _function(self, function: FunctionType, where: str) -> None:
        known = library_of(function.__code__.co_filename, function.__module__)
        if known:
            self.add(known, function.__qualname__)
        else:
            self.visit(function.__code__, where)
            self._each((function.__defaults__, function.__kwdefaults__), f"default of {where}")
            for name in sorted(_read_by(function.__code__, "LOAD_GLOBAL", "LOAD_NAME")):
                if name in function.__globals__:
                    self.add(name)
                    self.visit(function.__globals__[name], f"global {name}, read by {where},")
            for name in sorted(_read_by(function.__code__, "IMPORT_NAME")):
                self._imported(name, where)
        for name, cell in zip(function.__code__.co_freevars, function.__closure__ or ()):
            self.add(name)
            try:
                content = cell.cell_contents
            except ValueError:  # a name that is not bound yet
                continue
            self.visit(content, f"variable {name}, seen by {where},")

    def _code(self, code: CodeType, where: str) -> None:
        self.names.update(code.co_names)
        self.add(code.co_code, code.co_names, code.co_varnames, code.co_freevars, code.co_flags)
        self._each(code.co_consts, where)

    def _class(self, cls: type, where: str) -> None:
        module = sys.modules.get(cls.__module__)
        known = library_of(getattr(module, "__file__", None), cls.__module__) if module else None
        self.add(known or "class", cls.__qualname__)
        if known:
            return
        self._each(cls.__bases__, where)
        for name, member in sorted(vars(cls).items()):
            # methods generated by dataclasses follow from the fields, which are hashed too
            if name in OF_CLASS or getattr(getattr(member, "__code__", None), "co_filename", "") == "<string>":
                continue
            self.add(name)
            if isinstance(member, property):
                self._each((member.fget, member.fset), where)
            elif isinstance(member, classmethod | staticmethod):
                self.visit(member.__func__, where)
            elif name == "__dataclass_fields__":
                for field in member.values():
                    self.add(field.name, field.type, field.init, field.repr, field.hash, field.compare, field.kw_only)
                    for given in (field.default, field.default_factory):
                        if given is not dataclasses.MISSING:
                            self.visit(given, f"default of {cls.__qualname__}.{field.name}")
            elif not name.startswith("__") or callable(member):
                self.visit(member, f"{cls.__qualname__}.{name}")

    def _module(self, module: ModuleType, where: str) -> None:
        file = getattr(module, "__file__", None)
        known = library_of(file, module.__name__)
        self.add("module", known or module.__name__)
        if known or file is None:
            return
        self.modules[module.__name__] = module
        self.add(Path(file).read_bytes())
        for name, value in sorted(vars(module).items()):
            source = sys.modules.get(getattr(value, "__module__", None) or "")
            if isinstance(value, ModuleType):
                self.visit(value, where)
            elif source not in (None, module) and isinstance(value, type | FunctionType):
                self.add(name)
                self.visit(source, where)

    def _imported(self, name: str, where: str) -> None:
        if name in sys.modules:
            return self.visit(sys.modules[name], where)
        try:
            found = util.find_spec(name)
        except (ImportError, ValueError):
            found = None
        file = getattr(found, "origin", None)
        known = library_of(file, name)
        self.add("module", known or name)
        if not known and file and Path(file).is_file():
            self.add(Path(file).read_bytes())

    def _state(self, value: object, where: str) -> None:
        """Hash any other object by its class and its pickled state."""
        if isinstance(value, np.random.Generator | np.random.RandomState):
            raise StudyError(
                f"{where} is a random generator, so a case would depend on those before it: give the function a"
                " parameter `seed` and let it make its own"
            )
        try:
            parts = value.__reduce_ex__(4)
        except Exception as error:
            raise StudyError(
                f"{where} is a {type(value).__name__}, which cannot be compared from run to run:"
                " build it inside the function, or run with cache=None"
            ) from error
        self.add(type(value).__module__, type(value).__qualname__)
        if isinstance(parts, str):
            return self.add(parts)
        for i, part in enumerate(parts):
            self.visit(list(part) if i > 2 and part is not None else part, where)


def is_own(file: str | None, module: str | None) -> bool:
    """Whether a module is the user's own: not part of Python, of this package or of an installed library."""
    top = (module or "").partition(".")[0]
    if top in sys.stdlib_module_names or top == builtins.__name__:
        return False
    return file is None or not (file.startswith(LIBRARIES) or Path(file).is_relative_to(PACKAGE))


def library_of(file: str | None, module: str | None) -> str | None:
    """Name and version of the library that a module belongs to; None for the user's own."""
    if is_own(file, module):
        return None
    top = (module or "").partition(".")[0]
    if file is not None and Path(file).is_relative_to(PACKAGE):
        return f"workbench {own_source()}"
    return top if top in sys.stdlib_module_names else f"{top} {_version(top)}"


@functools.cache
def _version(top: str) -> str:
    try:
        return metadata.version(top)
    # a distribution with another name than its module; or a method that `dataclass` wrote for a class of no module
    except (metadata.PackageNotFoundError, ValueError):
        return str(getattr(sys.modules.get(top), "__version__", ""))


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _read_by(code: CodeType, *instructions: str) -> set[str]:
    """Names that instructions of these names read."""
    return {i.argval for part in _codes(code) for i in dis.get_instructions(part) if i.opname in instructions}
