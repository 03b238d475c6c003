"""What all figures have in common: letters of any script, labels and grid, and a legend that hides nothing."""

import warnings

import matplotlib.figure
from matplotlib import rcParams
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.font_manager import fontManager
from matplotlib.legend import Legend
from matplotlib.text import Text

_LINE_INCHES = 0.215  # of a legend
# Of Linux, Windows and macOS: the usual font has no letters of East Asia.
_EAST_ASIAN = (
    "Noto Sans CJK JP",
    "Noto Sans CJK SC",
    "Source Han Sans SC",
    "WenQuanYi Micro Hei",
    "WenQuanYi Zen Hei",
    "Droid Sans Fallback",
    "Microsoft YaHei",
    "Yu Gothic",
    "Malgun Gothic",
    "PingFang SC",
    "Hiragino Sans",
    "Arial Unicode MS",
)


class Figure(matplotlib.figure.Figure):
    """A figure with letters of whatever script there is a font for, wherever it is drawn; boxes stand for others."""

    def draw(self, renderer: RendererBase) -> None:
        """Draw it without a warning of each letter that has no font."""
        families = _families()
        for text in self.findobj(Text):
            text.set_fontfamily(families)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", r"Glyph \d+ ", UserWarning)
            super().draw(renderer)


def finish(axes: Axes, title: str, x: str, y: str) -> None:
    """Labels and grid as all figures have them; in the title, as it is a name, no $ begins a formula."""
    axes.set_title(title, loc="left", parse_math=False)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def legend_beside(figure: Figure, axes: Axes) -> None:
    """A legend where it hides nothing, on a figure that is high enough; one for axes that show the same methods."""
    legend = figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", frameon=False)
    hold_names(legend)
    figure.set_figheight(max(figure.get_figheight(), _LINE_INCHES * (len(legend.texts) + 1)))


def hold_names(legend: Legend) -> None:
    """Let no $ begin a formula in a legend."""
    for text in legend.texts:
        text.set_parse_math(False)


def _families() -> list[str]:
    """Fonts in which letters are looked for, one after the other."""
    there = {font.name for font in fontManager.ttflist}
    return [*rcParams["font.family"], *(name for name in _EAST_ASIAN if name in there)]
