"""Writes a URDF of one or two arms with closed grippers, without SRDF and robot.yaml."""

from __future__ import annotations

from pathlib import Path

__all__ = ["HEIGHT", "set_limits", "write_arms"]

HEIGHT = 0.35  # height of the root above the floor [m]


def _format_link(name: str, size: str = "", at: str = "0 0 0", mesh: str = "") -> str:
    geometry = f'<mesh filename="{mesh}"/>' if mesh else f'<box size="{size}"/>'
    shape = (
        f'<collision><origin xyz="{at}"/><geometry>{geometry}</geometry></collision>'
        if size or mesh
        else ""
    )
    return f'<link name="{name}">{shape}</link>'


def _format_joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    at: str,
    axis: str = "0 0 1",
    limits: tuple[float, float] = (-2, 2),
) -> str:
    limit = f'<limit lower="{limits[0]}" upper="{limits[1]}" effort="10" velocity="1.5"/>'
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{at}"/>'
        f'<parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="{axis}"/>{limit}</joint>'
    )


def set_limits(urdf: str, joint: str, lower: float, upper: float) -> str:
    """Return the URDF with the limits -2 and 2 of a joint replaced."""
    head, name, tail = urdf.partition(f'<joint name="{joint}"')
    limits = f'lower="{lower}" upper="{upper}"'
    return head + name + tail.replace('lower="-2" upper="2"', limits, 1)


def write_arms(
    folder: Path, *, sides: tuple[str, ...] = ("",), own_base: bool = False, mesh: str = ""
) -> Path:
    """Write robot.urdf into a folder and return it.

    The root is `HEIGHT` above the floor, and arms point up at 0. The hand points along its z axis;
    fingers close along its y axis and open from 0 to 80 mm between their faces.

    Args:
        folder: Output folder.
        sides: Name prefix of each arm: ("",), or ("left_", "right_").
        own_base: Whether the URDF has joints that drive the base.
        mesh: Mesh file of the base. Default: a box.
    """
    parts = []
    if own_base:
        parts += [_format_link("odom"), _format_link("slider"), _format_link("column")]
        parts += [
            _format_joint("drive_x", "prismatic", "odom", "slider", "0 0 0", "1 0 0", (-9, 9))
        ]
        parts += [
            _format_joint("drive_y", "prismatic", "slider", "column", "0 0 0", "0 1 0", (-9, 9))
        ]
        parts += [_format_joint("drive_yaw", "continuous", "column", "body", "0 0 0")]
    parts.append(
        _format_link("body", "" if mesh else "0.5 0.4 0.5", "0 0 0" if mesh else "0 0 -0.1", mesh)
    )
    for side in sides:
        y = {"left_": 0.3, "right_": -0.3}.get(side, 0.0)
        below = "body"
        at = f"0 {y} 0.16"
        for k, axis in enumerate(("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0")):
            name = f"{side}arm_{k + 1}"
            parts += [
                _format_link(name, "0.06 0.06 0.16", "0 0 0.1"),
                _format_joint(f"{name}_joint", "revolute", below, name, at, axis),
            ]
            below = name
            at = "0 0 0.2"
        parts += [
            _format_link(f"{side}hand", "0.05 0.14 0.06", "0 0 0.03"),
            _format_joint(f"{side}wrist", "fixed", below, f"{side}hand", at),
        ]
        for finger, sign in (("a", 1), ("b", -1)):
            name = f"{side}finger_{finger}"
            parts.append(_format_link(name, "0.02 0.01 0.08", f"0 {sign * 0.005} 0.04"))
            joint = _format_joint(
                f"{name}_joint",
                "prismatic",
                f"{side}hand",
                name,
                "0 0 0.06",
                f"0 {sign} 0",
                (0.0, 0.04),
            )
            parts.append(joint)
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "robot.urdf"
    file.write_text(f'<robot name="robot">{"".join(parts)}</robot>', encoding="utf-8")
    return file
