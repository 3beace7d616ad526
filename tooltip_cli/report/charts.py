"""Charts at print quality, each with its data, and the same drawing for the page.

A chart is drawn once. As a file it has fixed colours on white; in the page the same SVG takes its
colours from the style sheet, so that it follows light and dark.
"""

from __future__ import annotations

import functools
import io
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypeVar

from tooltip_cli.errors import MissingExtraError
from tooltip_cli.report.tables import csv_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

_Given = ParamSpec("_Given")
_Made = TypeVar("_Made")

INK, MUTED, GRID, PAPER = "#1b1f24", "#59636e", "#d5dae0", "#fefefe"
DETECTOR, BASELINE, DETECTION, TRUTH = "#1f62b0", "#c4501b", "#6b4fa8", "#1a7f4b"
CLOCK = "#8a6d00"
_VARIABLES = {
    INK: "ink",
    MUTED: "muted",
    GRID: "grid",
    PAPER: "paper",
    DETECTOR: "detector",
    BASELINE: "baseline",
    DETECTION: "detection",
    TRUTH: "truth",
    CLOCK: "clock",
}
WIDTH_IN = 3.8  # a journal's column and a phone's screen: text stays readable on both
PRINT_DPI = 300
_STYLE = {
    "font.size": 8.5,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "svg.fonttype": "none",
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.facecolor": "none",
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "text.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.4,
    "patch.linewidth": 0.0,
}


@dataclass(frozen=True)
class Drawing:
    """A figure in all its forms."""

    name: str  # file name without suffix
    title: str
    alt: str  # what a person who cannot see it should know
    caption: str  # plain text
    svg: bytes  # print quality
    png: bytes  # print quality
    data: str  # CSV
    inline: str  # SVG for the page, without its outer title


def styled(draw: Callable[_Given, _Made]) -> Callable[_Given, _Made]:
    """Let a function draw in this module's style, which leaves matplotlib's own settings alone."""

    @functools.wraps(draw)
    def inside(*args: _Given.args, **kwargs: _Given.kwargs) -> _Made:
        with _matplotlib().rc_context(_STYLE):
            return draw(*args, **kwargs)

    return inside


class Chart:
    """A matplotlib figure that becomes a :class:`Drawing`."""

    def __init__(
        self,
        height_in: float,
        width_in: float = WIDTH_IN,
        *,
        left: float = 0.55,
        right: float = 0.08,
        top: float = 0.08,
        bottom: float = 0.42,
    ) -> None:
        """Margins are inches: laying out by hand takes half the time of matplotlib's solver."""
        from matplotlib.figure import Figure

        self.canvas: Canvas = Figure(figsize=(width_in, height_in))
        self.canvas.subplots_adjust(
            left=left / width_in,
            right=1 - right / width_in,
            top=1 - top / height_in,
            bottom=bottom / height_in,
        )

    def axes(self, rows: int = 1, columns: int = 1, **options: Any) -> Any:
        """Return the axes of a grid of subplots."""
        return self.canvas.subplots(rows, columns, **options)

    def legend_above(self, columns: int) -> None:
        """Put the legend above the axes, where it hides nothing; each row takes 0.18 inches."""
        from matplotlib.container import Container

        handles, labels = self.canvas.axes[0].get_legend_handles_labels()
        order = sorted(range(len(handles)), key=lambda at: not isinstance(handles[at], Container))
        self.canvas.legend(
            [handles[at] for at in order],
            [labels[at] for at in order],
            loc="upper left",
            bbox_to_anchor=(0.0, 1.0),
            borderaxespad=0.1,
            ncols=columns,
            handletextpad=0.3,
            columnspacing=1.1,
        )

    def drawing(
        self,
        name: str,
        title: str,
        alt: str,
        caption: str,
        header: Sequence[str],
        rows: Iterable[Sequence[Any]],
    ) -> Drawing:
        """Render as SVG and PNG, and keep the data that reproduce it."""
        svg, png = io.BytesIO(), io.BytesIO()
        origin = {"Date": None, "Title": title}
        with _matplotlib().rc_context({"svg.hashsalt": name}):
            self.canvas.savefig(
                png,
                format="png",
                dpi=PRINT_DPI,
                facecolor="white",
                pil_kwargs={"compress_level": 2},  # higher levels cost seconds for a tenth less
            )
            self.canvas.savefig(svg, format="svg", metadata=origin, facecolor="white")
        text = svg.getvalue()
        return Drawing(
            name,
            title,
            alt,
            caption,
            text,
            png.getvalue(),
            csv_text(header, rows),
            inline_svg(text.decode(), alt),
        )


def _matplotlib() -> Any:
    try:
        import matplotlib
    except ImportError as error:
        raise MissingExtraError("the report", "report", "matplotlib") from error
    return matplotlib


def bare(axes: Axes, grid: Literal["x", "y", "both"]) -> None:
    """Keep the grid along one axis only: ``x``, ``y`` or ``both``."""
    axes.grid(False)
    axes.grid(True, axis=grid)
    axes.tick_params(length=0 if grid != "both" else 2.5)


_PROLOGUE = re.compile(r"^.*?(?=<svg)", re.DOTALL)
_METADATA = re.compile(r"<metadata>.*?</metadata>|<title>.*?</title>|<style.*?</style>", re.DOTALL)
_GROUP_ID = re.compile(r'<g id="[^"]*"')
_BACKGROUND = re.compile(r'<path d="[^"]*"\s*style="fill: #ffffff[^"]*"/>', re.DOTALL)


def inline_svg(text: str, alt: str) -> str:
    """Return a chart's SVG for the page: no prologue, no background, colours from the style sheet.

    Args:
        alt: the text alternative.
    """
    text = _METADATA.sub("", _PROLOGUE.sub("", text))
    text = _BACKGROUND.sub("", _GROUP_ID.sub("<g", text), count=1)
    head, body = text.split(">", 1)
    box = re.search(r'viewBox="[^"]*"', head)
    head = (
        f'<svg {box.group(0) if box else ""} role="img" aria-label="{escape(alt)}" '
        'stroke-linejoin="round" stroke-linecap="butt"'
    )
    for color, name in _VARIABLES.items():
        body = body.replace(color, f"var(--{name})")
    body = body.replace("'DejaVu Sans', sans-serif", "var(--font)")
    return f"{head}>{body.strip()}"


def escape(text: str) -> str:
    """Return text for HTML, attributes included."""
    pairs = (("&", "&amp;"), ("<", "&lt;"), (">", "&gt;"), ('"', "&quot;"), ("'", "&#39;"))
    for character, entity in pairs:
        text = text.replace(character, entity)
    return text
