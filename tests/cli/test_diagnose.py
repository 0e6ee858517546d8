"""`workbench diagnose`: faults of wiring are said before any search, and mended where that is asked for."""

from dataclasses import replace

import numpy as np

from workbench.cases.writing import write_case
from workbench.trials.make import make_trial


def write_exchanged(folder):
    """A case that hides nothing, with its first two inputs exchanged."""
    case, _ = make_trial(2)
    order = np.arange(len(case.rig.actuators))
    order[:2] = 1, 0

    def wired(records):
        return tuple(replace(record, inputs=record.inputs[order]) for record in records)

    return write_case(replace(case, fit=wired(case.fit[:2]), validation=wired(case.validation[:1])), folder)


def test_exchanged_inputs_stop_a_diagnosis_and_are_mended_on_request(run, tmp_path, monkeypatch):
    write_exchanged(tmp_path / "crossed")
    stopped = run("diagnose", tmp_path / "crossed", "--page", tmp_path / "p.html")
    assert stopped.exit_code == 2 and "The inputs F1 and F2 are exchanged: swap them in case.toml." in stopped.output
    assert "--mend" in stopped.output and not (tmp_path / "p.html").exists()
    seen = []

    def search(rig, records, *, validation, **options):
        seen.extend([*records, *validation])
        raise ValueError("the search has begun")

    monkeypatch.setattr("workbench.gap.diagnose.diagnose", search)
    for option, order in (("--mend", [0, 1]), ("--as-wired", [1, 0])):
        seen.clear()
        assert "the search has begun" in run("diagnose", tmp_path / "crossed", option).output
        real, _ = make_trial(2)
        for record, exact in zip(seen, (*real.fit[:2], *real.validation[:1]), strict=True):
            np.testing.assert_array_equal(record.inputs[:2], exact.inputs[order])


def test_a_validation_record_that_repeats_a_fit_record_is_refused(run, tmp_path):
    case, _ = make_trial(2)
    write_case(replace(case, fit=case.fit[:1], validation=(replace(case.fit[0], name="again"),)), tmp_path / "same")
    refused = run("diagnose", tmp_path / "same")
    assert refused.exit_code == 2 and "repeats the fit record" in refused.output
