"""Plots scenes and plans with matplotlib."""

from vkc_pin.visualization.plots.plots import plot, plot_clearance, plot_joints, plot_top_view

__all__ = ["plot", "plot_clearance", "plot_joints", "plot_top_view"]
