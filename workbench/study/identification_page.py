"""The page of an identification: shapes, damping, MAC, stabilisation diagram and frequency response."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from workbench.draw.identification import stabilisation_diagram
from workbench.draw.spectra import plot_frf, plot_spectra, plot_transfer
from workbench.identification.free_decay.ibrahim import stabilise, stable_modes
from workbench.records.record import Record
from workbench.records.transfer_functions import TransferFunctions
from workbench.study.pages.identification_report import IdentificationReport
from workbench.study.pages.page import PageContent, block
from workbench.study.report import identified

MOST_SAMPLES = 4096  # of each decay, in the stabilisation diagram
BEYOND = 8  # orders more than modes that it shows
SAMPLES_AN_ORDER = 8  # at least


def identification_page(
    report: IdentificationReport, measured: Sequence[Record | TransferFunctions], *, made_by: str
) -> PageContent:
    """The page of a report, and of the data that it is of."""
    content = identified({**report.content, "heading": report.heading, "lines": list(report.lines)})
    blocks = [*content.pop("blocks"), *_stabilisation(report), *_response(measured[0])]
    return PageContent(title="Identified modes", blocks=blocks, made_by=made_by, **content)


def _stabilisation(report: IdentificationReport) -> list[dict[str, Any]]:
    decays = [replace(decay, outputs=decay.outputs[:, :MOST_SAMPLES]) for decay in report.decays]
    if not decays:
        return []
    shortest = min(decay.n_samples for decay in decays)
    highest = min(len(report.rows) + BEYOND, shortest // SAMPLES_AN_ORDER)
    if highest < 2:
        return []
    diagram = stabilise(decays, orders=range(1, highest + 1))
    nyquist = 0.5 * decays[0].sample_rate_hz
    figure = stabilisation_diagram(diagram, stable_modes(diagram).modes, nyquist)
    return [block(figure, "Stabilisation diagram: the poles of models of each order; bands where they stay the same.")]


def _response(measured: Record | TransferFunctions) -> list[dict[str, Any]]:
    if isinstance(measured, TransferFunctions):
        return [block(plot_transfer(measured), "Magnitude of the transfer functions.")]
    if measured.n_inputs == 1 and np.ptp(measured.inputs):
        return [block(plot_frf(measured), "Frequency response functions and coherence.")]
    return [block(plot_spectra(measured), "Power spectral density, by Welch's method.")]
