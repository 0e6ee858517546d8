"""Imports run from the ground floor up, those inside functions too."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

import workbench

ROOT = Path(workbench.__file__).parent
FLOORS = {
    "arguments": -1,
    "arrays": -1,
    "deadline": -1,
    "renamed": -1,
    "threads": -1,
    "structure": 0,
    "records": 1,
    "rig": 2,
    "identification": 3,
    "design": 3,
    "cases": 3,
    "gap": 4,
    "robust": 5,
    "trials": 6,
    "draw": 7,
    "study": 8,
    "cli": 9,
}
# Rooms inside a room, ground floor first; the room's own files stand above them all.
INSIDE = {
    "identification": ("signal", "free_decay", "input_output", "output_only", "shapes", "updating"),
    "design": ("laws", "estimation", "loop", "export", "spillover", "placement"),
    "gap": ("effects", "prediction", "setup", "localisation", "search", "report"),
    "study": ("runs", "pages"),
}
ENGINES = {
    "casadi": {"design/placement/placement.py"},
    "matplotlib": {"draw/"},
    "pyuff": {"records/uff_file.py"},
    "nptdms": {"records/tdms_file.py"},
    "h5py": {"records/hdf5_file.py"},
    "typer": {"cli/"},
    "rich": {"cli/"},
}


@cache
def modules():
    """Each file's name, the modules that it imports, those inside functions too, and the names that it calls."""
    found = []
    for path in sorted(ROOT.rglob("*.py")):
        nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        called = {getattr(node.func, "id", "") for node in nodes if isinstance(node, ast.Call)}
        found.append((path.relative_to(ROOT).as_posix(), tuple(imports(nodes)), called))
    return found


def imports(nodes):
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            folder = ROOT.parent / node.module.replace(".", "/")
            for alias in node.names:
                # `from workbench.room import file` names the file, not the room
                yield f"{node.module}.{alias.name}" if (folder / f"{alias.name}.py").is_file() else node.module


def room(name: str) -> str:
    return name.split("/")[0].removesuffix(".py")


def test_a_room_imports_only_from_floors_below():
    wrong = []
    for name, targets, _ in modules():
        if name in ("__init__.py", "__main__.py"):
            continue
        for target in targets:
            parts = target.split(".")
            if parts[0] != "workbench" or len(parts) < 2 or parts[1] == room(name):
                continue
            if FLOORS[parts[1]] >= FLOORS[room(name)]:
                wrong.append(f"{name} imports {target}")
    assert not wrong, wrong


def inner_floor(parts: tuple[str, ...]) -> int:
    """Of a module inside its room."""
    rooms = INSIDE[parts[0]]
    return rooms.index(parts[1]) if parts[1] in rooms else len(rooms)


def test_imports_run_one_way_inside_a_room():
    wrong = []
    for name, targets, _ in modules():
        parts = tuple(name.removesuffix(".py").split("/"))
        if parts[0] not in INSIDE or len(parts) < 2:
            continue
        for target in targets:
            there = tuple(target.split(".")[1:])
            if len(there) > 1 and there[0] == parts[0] and inner_floor(there) > inner_floor(parts):
                wrong.append(f"{name} imports {target}")
    assert not wrong, wrong


def test_every_room_inside_a_room_is_named():
    for room_name, named in INSIDE.items():
        folders = {path.parent.name for path in (ROOT / room_name).glob("*/__init__.py")}
        assert folders == set(named), room_name


def test_no_file_imports_a_rooms_init():
    wrong = [
        f"{name} imports {target}"
        for name, targets, _ in modules()
        if name != "__init__.py"
        for target in targets
        if target == "workbench"
        or (
            target.startswith("workbench.")
            and (ROOT.parent / target.replace(".", "/")).is_dir()
            and target != "workbench.records"
        )
    ]
    assert not wrong, wrong


def test_no_circle_of_imports():
    graph = {}
    for name, targets, _ in modules():
        module = "workbench." + name.removesuffix(".py").replace("/", ".")
        graph[module] = {t for t in targets if t.startswith("workbench.")}
    done, path = set(), []

    def visit(module):
        assert module not in path, f"a circle: {' -> '.join([*path[path.index(module) :], module])}"
        if module in done or module not in graph:
            return
        path.append(module)
        for target in graph[module]:
            visit(target)
        path.pop()
        done.add(module)

    for module in graph:
        visit(module)


def test_each_engine_has_one_door():
    wrong = [
        f"{name} imports {engine}"
        for name, targets, _ in modules()
        for target in targets
        for engine, doors in ENGINES.items()
        if target.split(".")[0] == engine
        and not any(name.startswith(door) for door in doors)
        and not (engine == "matplotlib" and name == "study/runs/outcome.py")
    ]
    assert not wrong, wrong


def test_only_the_command_prints():
    wrong = [name for name, _, called in modules() if "print" in called and not name.startswith("cli/")]
    assert not wrong, wrong


@pytest.mark.parametrize(("page", "most"), [("gap", 15), ("identification", 8)])
def test_the_course_can_be_read_in_a_few_files(page, most):
    course = (ROOT.parent / f"docs/theory/{page}.md").read_text(encoding="utf-8").split("## Reading the code")[1]
    files = re.findall(r"^\| `([a-z_/]+)\.py` \|", course.split("\n## ")[0], re.MULTILINE)
    assert 1 < len(files) <= most
    imported = {name: set(targets) for name, targets, _ in modules()}
    for number, name in enumerate(files[1:], start=1):
        target = f"workbench.{page}.{name}".replace("/", ".")
        assert any(target in imported[f"{page}/{above}.py"] for above in files[:number]), name
