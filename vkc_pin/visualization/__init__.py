"""Shows scenes and plans with meshcat and matplotlib."""

from vkc_pin.visualization.viewer import animate, open_viewer, show, to_html

__all__ = ["animate", "open_viewer", "show", "to_html"]
