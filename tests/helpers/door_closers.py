"""Makes scenes whose objects have joint resistance and mass."""

from __future__ import annotations

import copy
from typing import Any

import yaml

import vkc_pin as vkc

__all__ = ["load_door_with_closer", "replace_object_fields"]


def replace_object_fields(scene: vkc.Scene, name: str, **fields: Any) -> vkc.Scene:
    """Return the scene with other fields of an object, or of its `joints`: joint → fields."""
    document = copy.deepcopy(dict(scene.document))
    item = next(item for item in document["objects"] if item["name"] == name)
    file = vkc.load_object(item["type"]).urdf
    assert file is not None
    description = yaml.safe_load(file.with_name(f"{item['type']}.yaml").read_text(encoding="utf-8"))
    joints = {joint: {**values} for joint, values in (description.get("joints") or {}).items()}
    for joint, values in fields.pop("joints", {}).items():
        joints[joint] = {**joints.get(joint, {}), **values}
    item["type"] = {
        **description,
        "joints": joints,
        "urdf": file.read_text(encoding="utf-8"),
        **fields,
    }
    return vkc.Scene.from_document(document, scene.folder)


def load_door_with_closer(**resistance: float) -> vkc.Scene:
    """Return the door scene with a resisting hinge."""
    return replace_object_fields(vkc.load_scene("door"), "door", joints={"hinge": resistance})
