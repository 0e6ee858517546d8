"""Versions of the software that a result depends on."""

import functools
import hashlib
import platform
from importlib import metadata
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2]
LIBRARIES = ("numpy", "scipy", "control", "casadi", "numba")


@functools.cache
def versions() -> dict[str, str]:
    """Versions of Python, of this workbench with a digest of its source, and of the numerical libraries."""
    found = {"python": platform.python_version(), "modal-workbench": f"{_installed('modal-workbench')}+{own_source()}"}
    return {**found, **{name: _installed(name) for name in LIBRARIES}}


@functools.cache
def own_source() -> str:
    """A digest of this package's source, which distinguishes edited sources of the same version."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:8]


def _installed(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"
