"""Pictures with meshcat: in a notebook, in the browser, or as one self-contained page."""

from vkc_pin.visualization.viewer import animate, open_viewer, show, to_html

__all__ = ["animate", "open_viewer", "show", "to_html"]
