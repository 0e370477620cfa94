"""Lists the kinds of furniture and appliances that are generated at random."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from vkc_pin.errors import InputError
from vkc_pin.procedural.furniture import generators
from vkc_pin.procedural.furniture.building import ObjectBuilder, Sampler
from vkc_pin.utils.arguments import check_choice, check_integer, check_mapping
from vkc_pin.utils.pickling import freeze
from vkc_pin.world.files.resources import check_path
from vkc_pin.world.files.writing import check_writable, write_atomically
from vkc_pin.world.models.object_file import load_object


@dataclass(frozen=True)
class Kind:
    """A kind of furniture.

    Attributes:
        make: Generates an object of random sizes.
        place: "wall" for an object in an opening of a wall, "floor", or "counter".
        beside: Width of the floor in front of it that must stay free on either side, for the robot
            and for doors [m].
    """

    make: Callable[[Sampler], ObjectBuilder]
    place: str
    beside: float


KINDS: Mapping[str, Kind] = freeze(
    {
        "cabinet": Kind(generators.make_cabinet, "floor", 0.7),
        "chest": Kind(generators.make_chest, "floor", 0.5),
        "dishwasher": Kind(generators.make_dishwasher, "floor", 0.6),
        "door": Kind(generators.make_door, "wall", 0.5),
        "drawers": Kind(generators.make_drawers, "floor", 0.5),
        "faucet": Kind(generators.make_faucet, "counter", 0.5),
        "microwave": Kind(generators.make_microwave, "counter", 0.6),
        "oven": Kind(generators.make_oven, "floor", 0.6),
        "refrigerator": Kind(generators.make_refrigerator, "floor", 0.7),
        "valve": Kind(generators.make_valve, "floor", 0.7),
    }
)
"""Kinds by name."""


def random_object(kind: str, seed: int = 0) -> dict[str, Any]:
    """Return a random piece of furniture or an appliance that can be opened or turned.

    The description, with URDF, joints, handles and attachments, is an input of `load_object`, and
    `type` of an object in a scene. It is reproducible. The base link is on the floor, or on a
    counter, with its front towards -x; a door's is on the hinge line, in the middle of a wall.

    Args:
        kind: `cabinet`, `chest` (with a lid), `dishwasher`, `door`, `drawers`, `faucet`,
            `microwave`, `oven`, `refrigerator` or `valve`.
        seed: Random seed, from 0.

    Raises:
        UnknownNameError: There is no such kind.
        InputError: `seed` is not an integer of at least 0.
    """
    own = KINDS[check_choice(kind, KINDS, "kind of furniture", "kind")]
    rng = np.random.default_rng([4, zlib.crc32(kind.encode()), check_integer(seed, "seed", low=0)])
    return own.make(Sampler(rng)).description


def write_object(description: Mapping[str, Any], path: str | Path) -> Path:
    """Write the description of an object to `<name>.yaml`, and a URDF that it contains beside it.

    Args:
        description: Result of `random_object`, or plain data of that form.
        path: Path of the file `<name>.yaml`.

    Returns:
        Path of the file, an input of `load_object` and of scenes.

    Raises:
        InputError: The description is invalid, or a file cannot be written.
    """
    plain = check_mapping(description, "description")
    file = check_path(path, "path")
    if file.suffix not in (".yaml", ".yml"):
        expected = "a path that ends with .yaml"
        raise InputError("not an object file", field="path", expected=expected, got=file.name)
    load_object(plain, folder=file.parent)  # raises an error if it is invalid
    check_writable(file)
    urdf = plain["urdf"]
    if urdf.lstrip().startswith("<"):
        urdf_file = write_atomically(file.with_suffix(".urdf"), urdf.encode())
        plain = {**plain, "urdf": urdf_file.name}
    return write_atomically(file, yaml.safe_dump(plain, sort_keys=False).encode())
