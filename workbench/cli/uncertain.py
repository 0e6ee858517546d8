"""The corrected rig with its uncertainty, from a verdict or a diagnosis, and the file of a verdict."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from workbench.cli.terminal import errors, short
from workbench.rig.rig import Rig

if TYPE_CHECKING:
    from workbench.cases.case import Case
    from workbench.gap.report.verdict import Verdict
    from workbench.robust.posterior import UncertainRig


def uncertain_rig(
    case: "Case", verdict: Path | None, *, workers: int | None, report: Callable[[str, float], None]
) -> "tuple[UncertainRig, tuple[float, ...] | None]":
    """The uncertain rig of a case, and the noise (n_outputs,) estimated by its diagnosis, which is run unless given.

    A new verdict is written to out/NAME-verdict.json. Certain faults of the set-up, such as swapped channels, are
    refused.
    """
    from workbench.gap.diagnose import SECONDS
    from workbench.gap.diagnose_case import diagnose_case
    from workbench.gap.setup.faults import setup_faults
    from workbench.gap.setup.records import check_disjoint
    from workbench.robust.posterior import UncertainRig

    if verdict is not None:
        return read_verdict(verdict, case.rig)
    check_disjoint(case.fit, case.validation)
    verdict_path = Path("out") / f"{case.name}-verdict.json"
    for fault in setup_faults(case.rig, case.fit, case.validation):
        if fault.certain:
            raise ValueError(
                f"{fault.sentence.rstrip('.')}; correct the case, or ignore the fault by `workbench diagnose CASE"
                f" --uncorrected --json {verdict_path.name}` and give that file as --verdict"
            )
    errors.print(f"  no --verdict: the case is diagnosed first, which takes up to {SECONDS:g} s of processor time")
    found = diagnose_case(case, workers=workers, progress=report)
    write_verdict(found, verdict_path)
    errors.print(f"  {found.sentence}")
    shown = short(verdict_path)
    errors.print(f"  verdict    {shown}: give --verdict {shown} to the next command to skip the diagnosis")
    return UncertainRig.of(found), found.budget.noise_found or None


def write_verdict(verdict: "Verdict", path: Path) -> None:
    """Write a verdict with its uncertainty as JSON for `read_verdict`."""
    from workbench.robust.posterior import UncertainRig
    from workbench.study.runs.whole_file import write_whole

    path.parent.mkdir(parents=True, exist_ok=True)
    shown = verdict.to_json() | {"posterior": UncertainRig.of(verdict).to_json()}
    write_whole(path, json.dumps(shown, indent=1, allow_nan=False) + "\n")


def read_verdict(path: Path, rig: Rig) -> "tuple[UncertainRig, tuple[float, ...] | None]":
    """The uncertain rig of a verdict in JSON, which must be of this rig, and the estimated noise (n_outputs,)."""
    from workbench.robust.posterior import UncertainRig

    if not path.is_file():
        raise ValueError(f"{path}: there is no such file; write it by `workbench diagnose CASE --json {path.name}`")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        posterior, noise = content["posterior"], content.get("noise", {}).get("found")
    except (OSError, json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, AttributeError):
        raise ValueError(
            f"{path} is not a verdict with uncertainty: write one by `workbench diagnose CASE --json verdict.json`"
        ) from None
    try:
        return UncertainRig.from_json(rig, posterior), tuple(noise) if noise else None
    except KeyError as error:
        raise ValueError(f"{path} is not a verdict of this case: it has no {error}; diagnose the case again") from None
    except (TypeError, IndexError, AttributeError):
        raise ValueError(f"{path} is not a verdict of this case: it is damaged; diagnose the case again") from None
