"""Makes a scene in which the robot holds a stick, and a motion that fetches a ball with it."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from helpers.carrying import (
    BALL,
    STICK,
    UP,
    MotionBuilder,
    compute_grasp_pose,
    describe_stand,
    lift,
    make_room,
    move_base,
    solve_above,
    solve_reach,
)
from vkc_pin.world.scene.scene import Scene

PULL = (np.pi / 2, 0.0, 0.0)  # orientation of the ball on the tip, which approaches from the right


def make_scene_with_held_stick() -> Scene:
    scene = make_room(describe_stand(), objects=("stick", "ball"))
    return scene.with_held({"stick": "grip"}, at={"stick": (0.02, -0.1)})


def make_fetching_motion() -> tuple[Scene, MotionBuilder]:
    """Return a motion in which a held stick lifts a ball, carries it aside and puts it down."""
    scene = make_room(describe_stand(), objects=("stick", "ball"))
    # The stick's tip is at the ball.
    south = pin.SE3(STICK.rotation, BALL.translation - np.array([0.0, 0.285, 0.0]))
    touch = solve_reach(compute_grasp_pose(south), solve_above(STICK))
    up = solve_reach(compute_grasp_pose(lift(south, UP / 4)), touch)
    scene = scene.with_held({"stick": "grip"}).with_start(arm=up[3:])
    script = MotionBuilder(scene).go(touch).take("ball", "pull", PULL, by="stick.tip").go(up)
    script.go(move_base(up, y=0.3)).go(move_base(touch, y=0.3)).let_go("ball")
    script.go(move_base(touch, y=0.1))
    return scene, script
