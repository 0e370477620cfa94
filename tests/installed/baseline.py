"""Opens a drawer by a baseline of the paper."""

from __future__ import annotations

import vkc_pin as vkc
from vkc_pin.experiments.baselines import plan_separately


def main() -> None:
    plan = plan_separately(vkc.load_scene("drawer"), [vkc.Actuate("drawer", {"slide": 0.2})])
    assert plan.success, plan.summary()


if __name__ == "__main__":
    main()
