"""Templates that a user begins with: a case folder, a study."""

from pathlib import Path

from workbench.study.cases import StudyError
from workbench.study.saved_design import NAME
from workbench.study.whole_file import write_whole

ASSETS = Path(__file__).with_name("assets")


def new_case(folder: Path) -> Path:
    """Write case.toml, commented, into a new case folder with an empty folder of records.

    Raises:
        StudyError: the folder has a case.toml.
    """
    path = folder / "case.toml"
    if path.exists():
        raise StudyError(f"{path} is there already; choose another folder")
    (folder / "records").mkdir(parents=True, exist_ok=True)
    return write_whole(path, (ASSETS / "case.toml").read_text(encoding="utf-8"))


def new_study(name: str, folder: Path) -> Path:
    """Write a commented study, folder/name.py.

    Raises:
        StudyError: a name that is none, or that is taken.
    """
    if not NAME.fullmatch(name):
        raise StudyError(
            f"a study's name is made of small letters, digits and _, and begins with a letter: {name!r:.60}"
        )
    path = folder / f"{name}.py"
    if path.exists():
        raise StudyError(f"{path} is there already; choose another name")
    return write_whole(path, (ASSETS / "study.py.txt").read_text(encoding="utf-8"))
