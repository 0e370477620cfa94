"""Pictures with matplotlib: joints and clearance over time, motions from above, and cards of notebooks."""

from vkc_pin.visualization.plots.plots import plot, plot_clearance, plot_joints, plot_top_view

__all__ = ["plot", "plot_clearance", "plot_joints", "plot_top_view"]
