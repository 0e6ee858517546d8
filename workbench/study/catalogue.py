"""Studies: scripts of one question each, found by name or path, and run."""

import ast
import hashlib
import importlib.util
import sys
import sysconfig
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from workbench.study.pages.page import study_page
from workbench.study.runs.cases import StudyError
from workbench.study.runs.fingerprint import is_own
from workbench.study.runs.outcome import Outcome


@dataclass(frozen=True)
class StudyFile:
    """A study's script.

    Attributes:
        path: of the file.
        name: its stem.
        question: the first line of its docstring.
        needs_data: what --data must name, where it must be given.
        fault: why it cannot be run, where it cannot.
        defined: whether there is a function `study`; without, it may hold what the studies beside it share.
    """

    path: Path
    name: str
    question: str
    needs_data: str | None
    fault: str | None = None
    defined: bool = True


def study_scripts(*, here_first: bool = False) -> dict[str, Path]:
    """The scripts by name: those in `studies/` here, and those that came with the package.

    Args:
        here_first: only those here, where there are any.
    """
    root = Path(__file__).resolve().parents[2]
    # beside the package as its source has it or as an installer's --target does, or where the interpreter keeps data
    installed = [folder / "share" / "workbench" / "studies" for folder in (root, Path(sysconfig.get_path("data")))]
    came = next((folder for folder in (root / "studies", *installed) if folder.is_dir()), installed[-1])
    folders = [Path.cwd() / "studies", came]
    scripts: dict[str, Path] = {}
    for folder in folders:
        if here_first and scripts:
            break
        for path in sorted(folder.glob("*.py")):
            scripts.setdefault(path.stem, path)
    if not scripts:
        raise StudyError("there are no studies: none came with the package, and no folder studies/ is here")
    return dict(sorted(scripts.items()))


def output_root(study: StudyFile) -> Path:
    """The folder that takes a study's figures, pages and results: its project, where we are in that, else this one."""
    project, here = study.path.resolve().parent.parent, Path.cwd()
    return project if here.is_relative_to(project) and study.path.resolve().parent.name == "studies" else here


class NoStudyError(StudyError):
    """A script without a function `study`."""


def describe(path: Path) -> StudyFile:
    """Read a study's question without running it."""
    try:
        tree = ast.parse(path.read_text(encoding="utf-8"))
    except (SyntaxError, ValueError, RecursionError, OSError) as error:
        raise StudyError(f"{path} is not a study: {error}") from error
    if not any(isinstance(node, ast.FunctionDef) and node.name == "study" for node in tree.body):
        raise NoStudyError(f"{path} defines no function study(outcome, data)")
    needs = None
    for node in tree.body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "NEEDS_DATA":
            try:
                needs = str(ast.literal_eval(node.value))
            except ValueError:
                raise StudyError(f"{path}: NEEDS_DATA is a text that says what --data must name") from None
    question = (ast.get_docstring(tree) or "").splitlines()
    return StudyFile(path, path.stem, question[0] if question else "", needs)


def list_studies(*, here_first: bool = False) -> list[StudyFile]:
    """All studies, by name; one that is unfinished has a fault and keeps no other from running."""
    return [_described(path) for path in study_scripts(here_first=here_first).values()]


def _described(path: Path) -> StudyFile:
    try:
        return describe(path)
    except StudyError as error:
        return StudyFile(path, path.stem, "", None, str(error), defined=not isinstance(error, NoStudyError))


def find_study(name: str) -> StudyFile:
    """A study by name, or by path.

    Raises:
        StudyError: naming the studies there are.
    """
    path = Path(name)
    if path.suffix == ".py":
        if not path.is_file():
            raise StudyError(f"there is no file {path}")
        return describe(path)
    found = study_scripts()
    if name not in found:
        raise StudyError(f"no study is called {name!r}; there are {', '.join(found)}")
    return describe(found[name])


def run_study(study: StudyFile, data: Path | None, outcome: Outcome, root: Path) -> tuple[Path, Path]:
    """Run a study; write its JSON (studies/results of its project, else out/results), its page and its tables (out).

    It can import what lies beside it.

    Returns:
        The paths of the JSON and of the page.

    Raises:
        StudyError: data that are needed and not given, or not there.
        Exception: what the study raises, with a note of the script and the line that it comes from.
    """
    if data is None and study.needs_data:
        raise StudyError(f"study {study.name} needs --data: {study.needs_data}")
    if data is not None and not data.exists():
        raise StudyError(f"--data {data}: there is no such file or folder")
    spec = importlib.util.spec_from_file_location(f"study_{study.name}", study.path)
    if spec is None or spec.loader is None:
        raise StudyError(f"{study.path} is no Python file")
    module = importlib.util.module_from_spec(spec)
    with _own_folder(study.path):
        spec.loader.exec_module(module)
        module.study(outcome, data)
    outcome.write_runs(root / "out")
    made_by = f"workbench study {study.name}" + (f" --data {data}" if data else "")
    page = study_page(outcome, root / "out", inputs=_inputs(study, data), made_by=made_by)
    owned = study.path.resolve().parent == root / "studies"
    return outcome.write(study.path.parent / "results" if owned else root / "out" / "results"), page


@contextmanager
def _own_folder(script: Path) -> Iterator[None]:
    """Imports from a script's folder, after all else so that no study stands for a library; errors say their line."""
    folder = str(script.resolve().parent)
    sys.path.append(folder)
    try:
        yield
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        own = [f for f in frames if Path(f.filename).is_file() and is_own(f.filename, None)]
        if own:
            error.add_note(f"{own[-1].filename}, line {own[-1].lineno}")
        raise
    finally:
        sys.path.remove(folder)


def _inputs(study: StudyFile, data: Path | None) -> dict[str, str]:
    """The script, and a checksum of the data."""
    found = {f"studies/{study.path.name}": study.path.read_text(encoding="utf-8")}
    if data is not None and data.is_file():
        found["data (SHA-256)"] = f"{hashlib.sha256(data.read_bytes()).hexdigest()}  {data.name}"
    return found
