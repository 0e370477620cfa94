"""Reads the commands and animations of a motion's HTML page."""

from __future__ import annotations

import base64
import gzip
import re
import struct
from typing import Any

import umsgpack


def read_commands(text: str) -> list[dict[str, Any]]:
    match = re.search(r'id="commands">([^<]*)<', text)
    assert match
    data = gzip.decompress(base64.b64decode(match[1]))
    at = 0
    found = []
    while at < len(data):
        (size,) = struct.unpack_from("<I", data, at)
        found.append(umsgpack.unpackb(data[at + 4 : at + 4 + size]))
        at += 4 + size
    return found


def read_clips(commands: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    (animation,) = (c for c in commands if c["type"] == "set_animation")
    return {a["path"]: a["clip"] for a in animation["animations"]}
