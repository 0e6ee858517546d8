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
        path, name: of the script, and its stem.
        question: the first line of the docstring.
        needs_data: what --data must name; None if the study needs no data.
        fault: why the study cannot be run; None if it can.
        defined: whether the script defines a function `study`; a script without one may be a module of other studies.
    """

    path: Path
    name: str
    question: str
    needs_data: str | None
    fault: str | None = None
    defined: bool = True


def study_scripts(*, here_first: bool = False) -> dict[str, Path]:
    """The scripts by name: those in `studies/` of the current folder, and those installed with the package.

    With `here_first` only those of the current folder, if there are any.
    """
    root = Path(__file__).resolve().parents[2]
    # beside the package (a source tree, or an installer's --target), or in the data folder of the interpreter
    installed = [folder / "share" / "workbench" / "studies" for folder in (root, Path(sysconfig.get_path("data")))]
    came = next((folder for folder in (root / "studies", *installed) if folder.is_dir()), installed[-1])
    here, others = ({path.stem: path for path in folder.glob("*.py")} for folder in (Path.cwd() / "studies", came))
    scripts = here if here_first and here else others | here
    if not scripts:
        raise StudyError("there are no studies: none are installed, and the current folder has no folder studies/")
    return dict(sorted(scripts.items()))


def output_root(study: StudyFile) -> Path:
    """The output folder of a study: its project if the current folder is inside, else the current folder."""
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
                raise StudyError(f"{path}: NEEDS_DATA must be a text that states what --data must name") from None
    question = (ast.get_docstring(tree) or "").splitlines()
    return StudyFile(path, path.stem, question[0] if question else "", needs)


def list_studies(*, here_first: bool = False) -> list[StudyFile]:
    """All studies, by name; an invalid script is listed with its fault, so that the others still run."""
    studies = []
    for path in study_scripts(here_first=here_first).values():
        try:
            studies.append(describe(path))
        except StudyError as error:
            defined = not isinstance(error, NoStudyError)
            studies.append(StudyFile(path, path.stem, "", None, str(error), defined))
    return studies


def find_study(name: str) -> StudyFile:
    """A study by name, or by path.

    Raises:
        StudyError: no study has this name; the message lists the names.
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

    The study can import modules from its own folder. Returned are the paths of the JSON and of the page.

    Raises:
        StudyError: needed data are not given, or do not exist.
        Exception: an exception of the study, with a note of its script and line.
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
    inputs = {f"studies/{study.path.name}": study.path.read_text(encoding="utf-8")}
    if data is not None and data.is_file():
        inputs["data (SHA-256)"] = f"{hashlib.sha256(data.read_bytes()).hexdigest()}  {data.name}"
    page = study_page(outcome, root / "out", inputs=inputs, made_by=made_by)
    owned = study.path.resolve().parent == root / "studies"
    return outcome.write(study.path.parent / "results" if owned else root / "out" / "results"), page


@contextmanager
def _own_folder(script: Path) -> Iterator[None]:
    """Allow imports from a script's folder, last on the path to shadow no library; add the line to exceptions."""
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
