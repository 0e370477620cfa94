"""Executes a plan in the physics simulation."""

from __future__ import annotations

import vkc_pin as vkc


def main() -> None:
    plan = vkc.plan(vkc.load_scene("drawer"), [vkc.Actuate("drawer", {"slide": 0.3})])
    result = plan.simulate()
    assert result.ok, result.summary()
    result.to_html("drawer.html")


if __name__ == "__main__":
    main()
