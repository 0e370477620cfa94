from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.furniture import BAR, write_flap

import vkc_pin as vkc
from vkc_pin.importing.proposals.picture import plot_attachments


def test_picture_has_a_panel_for_every_attachment(tmp_path: Path) -> None:
    from PIL import Image

    found = vkc.importing.propose_attachments(write_flap(tmp_path, BAR.format("")))
    figure = plot_attachments(found, tmp_path / "attachments.png")
    assert len(figure.axes) == len(found.found)
    assert [axes.get_title().split()[0] for axes in figure.axes] == [
        proposal.attachment.name for proposal in found.found
    ]
    pixels = np.asarray(Image.open(tmp_path / "attachments.png").convert("RGB"), int).reshape(-1, 3)
    blue = (pixels[:, 2] > pixels[:, 0] + 60).sum()  # the hand
    assert blue > 200 * len(found.found)


def test_picture_explains_missing_attachments(tmp_path: Path) -> None:
    with pytest.raises(vkc.InputError, match="proposals"):
        plot_attachments("drawer")  # type: ignore[arg-type]
    found = vkc.importing.propose_attachments(write_flap(tmp_path, thick=0.12))
    figure = plot_attachments(found)
    assert "120 mm at its thinnest" in figure.axes[0].texts[0].get_text()
