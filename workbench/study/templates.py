"""Templates of a case folder and of a study."""

import re
from pathlib import Path

from workbench.study.runs.cases import StudyError
from workbench.study.runs.whole_file import write_whole

ASSETS = Path(__file__).with_name("assets")
NAME = re.compile(r"[a-z][a-z0-9_]{0,40}")


def new_case(folder: Path) -> Path:
    """Write a commented case.toml into a new case folder with an empty folder of records.

    Raises:
        StudyError: the folder has a case.toml.
    """
    path = folder / "case.toml"
    if path.exists():
        raise StudyError(f"{path} exists already; choose another folder")
    (folder / "records").mkdir(parents=True, exist_ok=True)
    return write_whole(path, (ASSETS / "case.toml").read_text(encoding="utf-8"))


def new_study(name: str, folder: Path) -> Path:
    """Write a commented study, folder/name.py."""
    return write_whole(free_path(name, folder), (ASSETS / "study.py.txt").read_text(encoding="utf-8"))


def free_path(name: str, folder: Path) -> Path:
    """The path of a new study, folder/name.py; name.toml, for its structure, must not exist either.

    Raises:
        StudyError: an invalid name, or one that is taken.
    """
    if not NAME.fullmatch(name):
        raise StudyError(
            f"the name of a study has lower-case letters, digits and _, and begins with a letter; got {name!r:.60}"
        )
    path = folder / f"{name}.py"
    taken = next((file for file in (path, path.with_suffix(".toml")) if file.exists()), None)
    if taken:
        raise StudyError(f"{taken} exists already; choose another name")
    return path
