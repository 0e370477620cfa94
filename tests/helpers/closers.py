"""Scenes whose objects resist and weigh something."""

from __future__ import annotations

import copy
from typing import Any

import yaml

import vkc_pin as vkc

__all__ = ["load_door_with_closer", "load_tray_scene", "replace_object_fields"]


def replace_object_fields(scene: vkc.Scene, name: str, **fields: Any) -> vkc.Scene:
    """Return a scene with another description of an object: its fields, or joint → fields."""
    document = copy.deepcopy(dict(scene.document))
    item = next(item for item in document["objects"] if item["name"] == name)
    file = vkc.load_object(item["type"]).urdf
    assert file is not None
    about = yaml.safe_load(file.with_name(f"{item['type']}.yaml").read_text(encoding="utf-8"))
    joints = {joint: {**said} for joint, said in (about.get("joints") or {}).items()}
    for joint, said in fields.pop("joints", {}).items():
        joints[joint] = {**joints.get(joint, {}), **said}
    item["type"] = {**about, "joints": joints, "urdf": file.read_text(encoding="utf-8"), **fields}
    return vkc.Scene.from_document(document, scene.folder)


def load_door_with_closer(**resistance: float) -> vkc.Scene:
    """Return the door scene with a resisting hinge."""
    return replace_object_fields(vkc.load_scene("door"), "door", joints={"hinge": resistance})


def load_tray_scene(mass: float) -> vkc.Scene:
    """Return the tray scene with a mass of the tray [kg]."""
    return replace_object_fields(vkc.load_scene("tray"), "tray", mass=mass)
