"""Pictures with matplotlib: joints and clearance over time, motions from above, and what a notebook shows of a scene or plan."""

from vkc_pin.importing.proposals.picture import plot_attachments
from vkc_pin.visualization.plots.plots import plot, plot_clearance, plot_joints, plot_top_view

__all__ = ["plot", "plot_attachments", "plot_clearance", "plot_joints", "plot_top_view"]
