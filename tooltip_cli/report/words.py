"""What the numbers mean, in sentences; the page and the terminal say the same."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tooltip_cli.log.views import STORED_RIG
from tooltip_cli.method.evaluation import ErrorSummary
from tooltip_cli.report.model import (
    CandidateScore,
    ErrorShares,
    EstimateScore,
    EvaluationReport,
    RecordingReport,
    mean_of,
)

PERFECT_PX = 0.5  # nobody labels better than this
_COUNTED = 20  # times the baseline's error, above which their number says little
AS_GOOD, CLOSE = 1.25, 2.0  # times the baseline's error


@dataclass(frozen=True)
class Verdict:
    """Whether a tip is right, at a glance."""

    level: str  # good, fair, poor, or none where nothing can be said
    short: str  # a few words
    text: str  # a sentence


def verdict(row: RecordingReport) -> Verdict:
    """Judge one recording by the error beside its baseline's."""
    if row.status != "ok":
        why = " ".join(sentence(reason.text) for reason in row.reasons)
        return Verdict("none", row.status, f"{row.status.capitalize()}: {why}")
    detector, baseline = mean_of(row.detector_px), mean_of(row.baseline_px)
    if detector is None:
        return Verdict("none", "not measured", _without_labels(row))
    if baseline is None:
        text = f"The projected tip lies {detector:.1f} px from the labels; there is no baseline."
        return Verdict("none", f"{detector:.1f} px", text)
    times = detector / baseline if baseline > 0 else float("inf")
    text = (
        f"The tip estimated from detections projects {detector:.1f} px from the labels on "
        f"average, {times:.{1 if times < _COUNTED else 0}f} times the baseline's "
        f"{baseline:.1f} px."
    )
    # an estimate with status ok may carry reservations
    text = " ".join([text, *(sentence(reason.text) for reason in row.reasons)])
    nearest = None if row.detector is None else row.detector.nearest_px
    if nearest is not None and nearest < detector:
        return Verdict("fair", "two ends", f"{text} The nearest candidate: {nearest:.1f} px.")
    if detector <= max(AS_GOOD * baseline, PERFECT_PX):
        return Verdict("good", "as good as labels", text)
    if times <= CLOSE:
        return Verdict("fair", f"near: {times:.1f} × labels", text)
    short = f"off: {times:.1f} × labels" if times < _COUNTED else f"off by {detector:.0f} px"
    return Verdict("poor", short, text)


def sentence(text: str) -> str:
    """Return text with a capital at its start and a full stop at its end."""
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


def _without_labels(row: RecordingReport) -> str:
    why = "there are no labels" if row.labels is None else "no label shows the tip"
    text = f"Not measured: {why}."
    apart = None if row.detection is None else row.detection.consistency_px
    if apart is not None:
        text += (
            f" In {apart.count} held-out frames the detection lies {apart.median:.0f} px (median) "
            "from the projected tip."
        )
    return text


def share_words(shares: ErrorShares, nearest_px: float | None = None) -> str:
    """Say in plain words where the mean error comes from.

    Args:
        nearest_px: error of the nearest of several ends, where there are several.
    """
    total, detection = shares.total_px, shares.detection_px
    if detection > 0:
        text = (
            f"Of {total:.1f} px, {detection:.1f} px come from detection: they go when labels take "
            "the place of detections."
        )
        if nearest_px is not None and nearest_px < total - 0.05:
            text += (
                f" {total - nearest_px:.1f} px of these are the choice between the tool's ends: "
                f"the nearest gives {nearest_px:.1f} px."
            )
    else:
        text = (
            f"Detection adds nothing: {total:.1f} px, where estimating from the labels themselves "
            f"gives {total - detection:.1f} px."
        )
    rest = f" {shares.calibration_px:.1f} px remain for calibration and the labels' own noise"
    if shares.label_noise_px is not None:
        rest += (
            f"; the labels alone lie {shares.label_noise_px:.1f} px from the true pixel, so the "
            "calibration has " + _calibration_part(shares)
        )
    return f"{text} {_clock_words(shares)}{rest}."


def _calibration_part(shares: ErrorShares) -> str:
    # errors of independent sources add in squares, not in sum
    noise = shares.label_noise_px or 0.0
    left = np.sqrt(max(0.0, shares.calibration_px**2 - noise**2))
    return "no visible part" if left < 0.25 * max(noise, 0.1) else f"about {left:.1f} px"


def _clock_words(shares: ErrorShares) -> str:
    if shares.clock_offset_ms is None or shares.clock_deviation_ms is None:
        return "The clocks cannot be judged from these views."
    offset = f"{shares.clock_offset_ms:+.1f} ± {shares.clock_deviation_ms:.1f} ms"
    if not shares.clock_shown:
        return f"The clocks have no share: the labels show no offset ({offset})."
    if shares.clock_px < 0.05:
        return f"The clocks hardly matter, although the labels show an offset of {offset}."
    return (
        f"{shares.clock_px:.1f} px come from synchronisation: the labels fit best with "
        f"{offset} added to the image stamps (time_offset in the rig file)."
    )


def position_words(score: EstimateScore) -> str:
    """Return the tip and its standard deviations, millimetres in the hand frame."""
    if score.position_m is None:
        return "none"
    deviations = score.deviations_mm or (None, None, None)
    parts = []
    for axis, value, deviation in zip("xyz", score.position_m, deviations, strict=True):
        spread = "" if deviation is None else f" ± {deviation:.1f}"
        parts.append(f"{axis} {1000 * value:.1f}{spread}")
    return ", ".join(parts) + "\u00a0mm"


def region_words(score: EstimateScore) -> str:
    """Say how the 95 % region is shaped, and whether it holds the truth."""
    if score.region_mm is None or score.region_axes is None:
        return "unknown"
    longest, middle, shortest = score.region_mm
    along = ", ".join(f"{value:+.2f}" for value in score.region_axes[0])
    text = (
        f"semi-axes {longest:.1f}, {middle:.1f} and {shortest:.1f} mm, the longest along ({along})"
    )
    if score.inside_region is None:
        return text
    if score.inside_region:
        return f"{text}; it holds the true tip"
    if score.ambiguous:
        return f"{text}; the true tip lies outside, see the other candidates"
    return f"{text}; the true tip lies outside, so the stated uncertainty is too small"


def percent(share: float) -> str:
    """Return a share as a whole percentage that is not torn from its sign."""
    return f"{100 * share:.0f}\u00a0%"


def end_words(end: CandidateScore) -> str:
    """Say of one of several ends where it is and how good."""
    place = ", ".join(f"{1000 * value:.1f}" for value in end.position_m)
    text = f"({place}) mm, support {percent(end.support)}"
    if end.error_px is not None:
        text += f", {end.error_px:.1f} px from the labels"
    if end.tip_error_mm is not None:
        text += f", {end.tip_error_mm:.1f} mm from the true tip"
    return text


def prefer_command(row: RecordingReport, end: CandidateScore) -> str:
    """Return the command line that takes this one of several ends."""
    rig = str(row.provenance["rig"]["source"])
    given = "" if rig.endswith(STORED_RIG) else f" --rig {shlex.quote(rig)}"
    refine = row.provenance["rig"].get("refine", "auto")
    given += "" if refine == "auto" else f" --refine {refine}"
    direction = ",".join(f"{value:.3f}" for value in end.position_m)
    return f"tooltip estimate {shlex.quote(row.recording)}{given} --prefer={direction}"


def axis_words(score: EstimateScore) -> str | None:
    """Return the tool's axis at its end, and how far off it may be; None: not known."""
    first = score.candidates[0] if score.candidates else None
    if first is None or first.axis is None:
        return None
    along = ", ".join(f"{value:+.3f}" for value in first.axis)
    spread = "" if first.axis_deg is None else f" ± {first.axis_deg:.1f} degrees"
    return f"({along}){spread}"


def detection_words(row: RecordingReport) -> str:
    """Say how often and how well the 2D detector finds the tip."""
    found = row.detection
    if found is None:
        return "none"
    flags = ", ".join(f"{count} {flag.replace('_', ' ')}" for flag, count in found.flags.items())
    text = f"{found.valid} of {found.pairs} pairs of images" + (f" ({flags})" if flags else "")
    if found.error_px is not None and found.within_10_px is not None:
        text += (
            f"; {percent(found.within_10_px)} of {found.error_px.count} in test frames lie within "
            f"10 px of the label, median {found.error_px.median:.0f} px"
        )
    return text


def label_words(row: RecordingReport) -> str:
    """Say what the labels are."""
    labels = row.labels
    if labels is None:
        return f"none; make them with: tooltip label {row.name}.mcap"
    text = f"{labels.visible} visible, {labels.hidden} hidden, by {', '.join(labels.labelers)}"
    if labels.simulated:
        text += " (simulated)"
    if labels.annotator_px is not None:
        text += (
            f"; a second labeller differs by {labels.annotator_px.mean:.1f} px on average over "
            f"{labels.annotator_px.count} frames"
        )
        if labels.disagreements:
            text += f", and on visibility in {labels.disagreements} frames"
    return text


def training_words(row: RecordingReport) -> str | None:
    """Say whether fewer training frames would have done (4.4)."""
    points = [point for point in row.training if point.error_px is not None]
    if len(points) < 2 or points[-1].error_px is None:
        return None
    final = points[-1].error_px
    enough = points[-1].frames
    for point in reversed(points[:-1]):
        if point.high_px is None or point.high_px > 1.1 * final or point.refused:
            break
        enough = point.frames
    if enough == points[-1].frames:
        return f"more than {points[-2].frames} are needed, maybe more than the {enough} there were"
    tried = max(point.repeats for point in points)
    drawn = "drawn once" if tried == 1 else "every time"
    return f"{enough} do as well as all {points[-1].frames} (within 10 %, {drawn})"


def headline(report: EvaluationReport) -> str:
    """Return the answer in one or two sentences."""
    overall = report.overall
    count = overall.recordings
    text = f"{count} recording{'s' if count != 1 else ''}: {overall.ok} estimated"
    text += f", {overall.refused} refused" if overall.refused else ""
    text += f", {overall.failed} failed" if overall.failed else ""
    text += "."
    if overall.detector_px is not None and overall.baseline_px is not None:
        tools = "the tool" if overall.compared == 1 else f"{overall.compared} tools"
        text += (
            f" Estimated from motion, the tip of {tools} projects "
            f"{interval(overall.detector_px)} px from the labels on average."
            f"{_ends_words(report)} Estimated from the labels themselves: "
            f"{interval(overall.baseline_px)} px."
        )
    if not any(row.labels for row in report.recordings):
        text += " There are no labels, so no error in pixels is known."
    if overall.tip_error_mm is not None:
        text += (
            f" The estimate lies {overall.tip_error_mm.mean:.1f} mm from the true tip on average."
        )
    if any(row.labels is not None and row.labels.simulated for row in report.recordings):
        text += " The labels are simulated, not placed by a person."
    return text


def _ends_words(report: EvaluationReport) -> str:
    """Say what choosing the nearest of several ends would change."""
    rows = [row for row in report.recordings if row.detector_px and row.baseline_px]
    means = [row.detector_px.mean for row in rows if row.detector_px]
    nearest = [
        mean if row.detector is None or row.detector.nearest_px is None else row.detector.nearest_px
        for row, mean in zip(rows, means, strict=True)
    ]
    wrong = [
        row.name for row, mean, best in zip(rows, means, nearest, strict=True) if best < mean - 0.05
    ]
    if not wrong:
        return ""
    names = ", ".join(wrong[:4]) + (" ..." if len(wrong) > 4 else "")
    return (
        f" With the nearest of the several ends of {names}, it would be {np.mean(nearest):.2f} px."
    )


def interval(error: ErrorSummary) -> str:
    """Return a mean with its 95 % interval."""
    if error.low is None or error.high is None:
        return f"{error.mean:.2f}"
    return f"{error.mean:.2f} [{error.low:.2f}, {error.high:.2f}]"


def caveats(report: EvaluationReport) -> Iterator[str]:
    """Yield what a reader must know before quoting a number."""
    rows = [row for row in report.recordings if row.split is not None]
    kinds = {row.split.kind for row in rows if row.split is not None}
    if "labels" in kinds:
        yield (
            "The labelled frames are the test set. Training frames are drawn from the rest with "
            f"seed {report.options['seed']}; no labelled frame trains anything."
        )
    if "random" in kinds:
        yield (
            f"The test frames are drawn at random with seed {report.options['seed']}, as in the "
            "paper."
        )
    if "blocks" in kinds:
        yield (
            "The test frames are contiguous blocks at places drawn with seed "
            f"{report.options['seed']}."
        )
    else:
        yield (
            "Test frames lie among training frames. Neighbours at 30 Hz resemble one another, so "
            "the errors say how well the estimate holds in this recording, not in another one."
        )
    if any(row.baseline_px for row in rows):
        yield (
            "The baseline is scored on the same labels that it was fitted to, as in the paper; it "
            "is a lower bound for what these labels and the rig as it is allow, not a competitor."
        )
    if any(row.labels and row.labels.simulated for row in rows):
        yield (
            "Labels by 'sim' are simulated: the true pixel with noise added, not a person's click."
        )
    yield (
        "Brackets hold 95 % intervals of the mean from 2000 bootstrap draws of blocks of "
        "neighbouring frames, widened as Student's t asks for that many blocks. Intervals of means "
        "over tools are for these tools; other tools would differ more."
    )
    yield (
        f"'As good as labels' means at most {AS_GOOD:g} times the baseline's error, 'near' at most "
        f"{CLOSE:g} times. The shares of "
        "an error are differences of means and add up to it; the clock's offset is fitted to the "
        "labels and counts only where it is larger than twice its deviation."
    )
