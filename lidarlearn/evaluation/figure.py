"""What all figures share: text in any script, labels and grid, and a legend that hides nothing."""

import warnings

import matplotlib.figure
from matplotlib import rcParams
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.font_manager import fontManager
from matplotlib.legend import Legend
from matplotlib.text import Text

_LINE_INCHES = 0.22  # height of one line of a legend, with Matplotlib < 3.11, whose lines are higher
# Fonts of Linux, Windows and macOS, as Matplotlib's own has no East Asian letters.
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
    """A figure with text in any script that an installed font supports; other letters are drawn as boxes."""

    def draw(self, renderer: RendererBase) -> None:
        """Draw without warnings about letters that no font has."""
        families = _font_families()
        for text in self.findobj(Text):
            text.set_fontfamily(families)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", r"Glyph \d+ ", UserWarning)
            super().draw(renderer)


def finish(axes: Axes, title: str, x: str, y: str) -> None:
    """Set labels and grid as in all figures. The title is a name, in which a $ does not begin a formula."""
    axes.set_title(title, loc="left", parse_math=False)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def legend_beside(figure: Figure, axes: Axes) -> None:
    """Add the legend of these axes beside all axes, and make the figure high enough for it."""
    legend = figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", frameon=False)
    disable_formulas(legend)
    figure.set_figheight(max(figure.get_figheight(), _LINE_INCHES * (len(legend.texts) + 1)))


def disable_formulas(legend: Legend) -> None:
    """Show a $ in the names of a legend as it is."""
    for text in legend.texts:
        text.set_parse_math(False)


def _font_families() -> list[str]:
    """The fonts to search for each letter, in this order."""
    there = {font.name for font in fontManager.ttflist}
    return [*rcParams["font.family"], *(name for name in _EAST_ASIAN if name in there)]
