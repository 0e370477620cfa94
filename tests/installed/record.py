"""Writes a plan as a ROS 2 bag, and reads it."""

from __future__ import annotations

from rosbags.rosbag2 import Reader

import vkc_pin as vkc


def main() -> None:
    plan = vkc.plan(vkc.load_scene("drawer"), [vkc.Actuate("drawer", {"slide": 0.3})])
    with Reader(plan.to_rosbag("bag")) as reader:
        assert "/vkc/arm/joint_trajectory" in reader.topics


if __name__ == "__main__":
    main()
