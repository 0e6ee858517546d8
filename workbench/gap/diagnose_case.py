"""The diagnosis of a case: `diagnose` itself needs no files."""

from typing import Any

from workbench.cases.case import Case
from workbench.gap.diagnose import diagnose
from workbench.gap.report.verdict import Verdict


def diagnose_case(case: Case, **options: Any) -> Verdict:
    """`diagnose` of a case, stated in its units.

    Args:
        case: rig and records.
        options: of `diagnose`.
    """
    return diagnose(case.rig, case.fit, validation=case.validation, name=case.name, units=case.units, **options)
