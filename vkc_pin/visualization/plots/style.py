"""Defines the common style of figures, and creates and saves them without pyplot."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vkc_pin.utils.notebook import in_notebook
from vkc_pin.world.files.writing import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from vkc_pin.world.trajectory.trajectory import Trajectory


COLOURS = ("#2f6db5", "#d1495b", "#2a9d6f", "#e08e1b", "#7a5195", "#5b6770", "#1b9aaa", "#a44a3f")
"""Colours of lines and bars, in this order."""
STYLE: Any = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "font.size": 9,
    "legend.frameon": False,
}
"""matplotlib parameters of all figures."""


def use_style() -> Any:
    """Return a context that applies the style; in a notebook, figures are displayed afterwards."""
    import matplotlib

    if in_notebook():
        import matplotlib_inline.backend_inline  # noqa: F401 - a notebook shows figures once this has been imported
    return matplotlib.rc_context(STYLE)


def new_figure(width: float, height: float) -> Figure:
    """Create an empty figure of the given size [inch]."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, path: str | Path | None) -> Figure:
    """Save a figure atomically in the format of the extension (None: not at all) and return it."""
    if path is not None:
        buffer = io.BytesIO()
        figure.savefig(buffer, format=Path(path).suffix.lower()[1:], dpi=130, facecolor="white")
        write_atomically(path, buffer.getvalue())
    return figure


def shade_phases(axes: Axes, trajectory: Trajectory) -> None:
    """Shade every other phase of a motion, over time [s]."""
    for phase in trajectory.phases[1::2]:
        first, last = trajectory.times[[phase.first, phase.last]].tolist()
        axes.axvspan(first, last, color="0.5", alpha=0.10, linewidth=0.0, zorder=0)
