"""Draw the validation errors of several trainings over the epochs, from their TensorBoard events.

`python docs/training_curves.py RUN RUN ...` writes docs/images/training_curves.png.
"""

import sys
from pathlib import Path

from matplotlib.ticker import MaxNLocator
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from lidarlearn.evaluation.plots import Panel, curves_figure

_IMAGES = Path(__file__).parent / "images"
_PANELS = {
    "translation error [% of the motion]": "val/mean_relative_translation_error_percent",
    "rotation error [deg]": "val/mean_relative_rotation_error_deg",
}


def main(runs: list[Path]) -> None:
    """Read the curves of all runs and draw them."""
    events = {run.name: EventAccumulator(str(run)).Reload() for run in runs}
    panels = [
        Panel("epoch", what, {name: curve(e, tag) for name, e in events.items()}) for what, tag in _PANELS.items()
    ]
    figure = curves_figure("validation drives", panels)
    for axes in figure.axes:
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.savefig(_IMAGES / "training_curves.png")


def curve(events: EventAccumulator, tag: str) -> dict[float, float]:
    """The values of a scalar by the number of epochs."""
    return {float(i + 1): event.value for i, event in enumerate(events.Scalars(tag))}


if __name__ == "__main__":
    main([Path(argument) for argument in sys.argv[1:]])
