"""Makes the pictures in docs/images: plans the door, or loads a saved plan of it, and looks at it. Needs Chromium."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
IMAGES = ROOT / "docs" / "images"
MOMENT = 14.0  # [s] of the motion: the door is half open


def main() -> int:
    """Write the pictures; return 1 if there is no motion to show."""
    sys.path.insert(0, str(ROOT / "tests"))
    from browser import screenshot

    import vkc_pin as vkc

    if len(sys.argv) > 1:
        plan = vkc.Plan.load(sys.argv[1])
    else:
        plan = vkc.plan(vkc.load_scene("door"), [vkc.Actuate("door", {"hinge": 1.2})])
    sys.stdout.write(plan.report() + "\n")
    if not plan.success:
        return 1
    with tempfile.TemporaryDirectory() as folder:
        page = plan.to_html(Path(folder) / "door.html")
        screenshot(page, IMAGES / "door.png", time=min(MOMENT, float(plan.trajectory.times[-1])), size=(1200, 640))
        plan.plot(folder)
        for name in ("joints", "clearance", "top_view"):
            (IMAGES / f"door_{name}.png").write_bytes((Path(folder) / f"{name}.png").read_bytes())
    return 0


if __name__ == "__main__":
    sys.exit(main())
