"""Checked values of the tables of a case file; any other value is refused by a `CaseError`."""

import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from reprlib import Repr
from types import MappingProxyType
from typing import Any

import numpy as np

MOST_BYTES = 2**24
MOST_ENTRIES = 1000
MOST_LETTERS = 60  # of a word that is compared with those allowed
NO_SYNONYMS: Mapping[str, str] = MappingProxyType({})
_DEEP_KEY = re.compile(r"(?<![\w\"'-])(?:[\w\"'-]++[ \t]*+\.[ \t]*+){100}")
_SINGLE = re.compile(r"^[ \t]*\[[ \t]*(input|output|record)[ \t]*\]", re.MULTILINE)

_REPR = Repr()
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = 60
_REPR.maxlist = 20
shown = _REPR.repr


class CaseError(ValueError):
    """An invalid case folder, or contents that a diagnosis cannot use."""


def table_of(path: Path) -> dict[str, Any]:
    """The table of a TOML file; any other file, or one of more than `MOST_BYTES`, is refused by a `CaseError`."""
    try:
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise CaseError(f"{path} has {size} bytes; a case file has at most {MOST_BYTES}")
        text = path.read_text(encoding="utf-8")
        if _DEEP_KEY.search(text):  # the cost of tomllib grows with the square of the number of parts of a key
            raise CaseError(f"{path} cannot be read as TOML: a key has a hundred parts or more")
        return tomllib.loads(text)
    except CaseError:
        raise
    except RecursionError:
        raise CaseError(f"{path} cannot be read as TOML: its brackets are nested too deeply") from None
    except OSError as error:
        raise CaseError(f"{path} cannot be read as TOML: {error}") from error
    except ValueError as error:
        single = _SINGLE.search(text) if isinstance(error, tomllib.TOMLDecodeError) else None
        remedy = f"; {_brackets(single[1])}" if single else ""
        raise CaseError(f"{path} cannot be read as TOML: {error}{remedy}") from error


def _brackets(key: str) -> str:
    return f"write [[{key}]], with two brackets, for each {key}"


def check_keys(entry: dict[str, Any], allowed: Iterable[str], where: str) -> None:
    """Refuse an unknown key by a `CaseError`: a misspelt one would otherwise change the case unnoticed."""
    allowed = list(allowed)
    for key in entry:
        if key not in allowed:
            close = get_close_matches(key, allowed, 1)
            meant = f"did you mean {close[0]!r}?" if close else f"the keys are {', '.join(allowed)}"
            raise CaseError(f"{where} has no key {shown(key)}; {meant}")


def tables(table: dict[str, Any], key: str, path: Path) -> list[dict[str, Any]]:
    """The entries [[key]], at least one, with unique names."""
    entries = table.get(key)
    if isinstance(entries, dict):
        raise CaseError(f"{path}: [{key}] has one bracket; {_brackets(key)}")
    if not isinstance(entries, list) or not entries or not all(isinstance(e, dict) for e in entries):
        raise CaseError(f"{path}: at least one [[{key}]] is needed")
    if len(entries) > MOST_ENTRIES:
        raise CaseError(f"{path}: {len(entries)} [[{key}]]; at most {MOST_ENTRIES} are read")
    names = [text(entry, "name", f"{path}: [[{key}]]") for entry in entries]
    for name in names:
        if names.count(name) > 1:
            raise CaseError(f"{path}: two [[{key}]] are called {shown(name)}; names must differ")
    return entries


def _got(entry: dict[str, Any], key: str) -> str:
    """What stands under a key, for a message."""
    return f"got {shown(entry[key])}" if key in entry else "it is missing"


def text(entry: dict[str, Any], key: str, where: str) -> str:
    """The text of printable characters under `key`."""
    value = entry.get(key)
    if not isinstance(value, str) or not value or not value.isprintable() or len(value) > 255:
        raise CaseError(f"{where}: {key} must be a text of up to 255 printable characters; {_got(entry, key)}")
    return value


def one_of(
    entry: dict[str, Any], key: str, allowed: Sequence[str], where: str, *, synonyms: Mapping[str, str] = NO_SYNONYMS
) -> str:
    """The text under `key`, one of those allowed; synonyms, {what others say: allowed text}, help in the message."""
    value = text(entry, key, where)
    if value not in allowed:
        raise CaseError(f"{where}: {key} is one of {', '.join(allowed)}; got {suggesting(value, allowed, synonyms)}")
    return value


def suggesting(value: object, allowed: Iterable[str], synonyms: Mapping[str, str] = NO_SYNONYMS) -> str:
    """A value that is not allowed, for a message, and the allowed text that is probably meant."""
    word = str(value).lower().replace("-", " ").replace("_", " ")[:MOST_LETTERS]
    if word in synonyms:
        return f"{shown(value)}, which is {synonyms[word]!r} here"
    close = get_close_matches(word, allowed, 1)
    return shown(value) + (f"; did you mean {close[0]!r}?" if close else "")


def inside(folder: Path, file: str, where: str) -> Path:
    """The path of a file named in a case, which must lie in the case folder."""
    try:
        path = (folder / file).resolve()
    except (OSError, RuntimeError) as error:  # symbolic links that form a loop
        raise CaseError(f"{where}: file {file!r} cannot be found: {error}") from error
    if not path.is_relative_to(folder.resolve()):
        raise CaseError(f"{where}: file {file!r} lies outside the case folder")
    return path


def number(entry: dict[str, Any], key: str, where: str, *, low: float = -np.inf) -> float:
    """The finite number under `key`, at least `low`."""
    value = _as_float(entry.get(key))
    if not np.isfinite(value) or value < low:
        limit = "" if low == -np.inf else f" of {low:g} or more"
        raise CaseError(f"{where}: {key} must be a number{limit}; {_got(entry, key)}")
    return value


def numbers(entry: dict[str, Any], key: str, where: str, length: int | None = None) -> np.ndarray:
    """The list of finite numbers under `key`, of this length if given."""
    given = entry.get(key)
    values = np.array([_as_float(value) for value in given] if isinstance(given, list) else [], float)
    if values.size == 0 or not np.isfinite(values).all() or values.size != (length or values.size):
        many = "numbers" if length is None else f"{length} numbers"
        raise CaseError(f"{where}: {key} must be a list of {many}; {_got(entry, key)}")
    return values


def _as_float(value: object) -> float:
    """A number as a float; infinite where it is too large, nan where it is no number."""
    try:
        return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else np.nan
    except OverflowError:
        return np.inf


def profile(entry: dict[str, Any], key: str) -> float | tuple[np.ndarray, np.ndarray]:
    """The profile under `key`: a number, or points (x, value) with linear interpolation between them."""
    value = entry.get(key)
    if isinstance(value, dict):
        check_keys(value, ("x", "value"), f"[structure] {key}")
        return numbers(value, "x", key), numbers(value, "value", key)
    return number(entry, key, "[structure]", low=0.0)


def count(entry: dict[str, Any], key: str, most: int) -> int:
    """The whole number from 1 to `most` under `key`."""
    value = entry.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
        raise CaseError(f"[structure]: {key} must be a whole number from 1 to {most}; {_got(entry, key)}")
    return value
