"""Hold: what is held, where, and through what."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from vkc_pin.errors import InputError, UnknownNameError

__all__ = ["Hold", "as_mappings", "holds_of"]


@dataclass(frozen=True)
class Hold:
    """One object held at one of its attachments, by the robot's tool or through another object that is held.

    Attributes:
        object: Its name in the scene.
        attachment: Where it is held.
        by: The hold of the object that it is held through (a stick); None: the robot's tool holds it.
        link: The link of that object which takes the place of the tool frame.
    """

    object: str
    attachment: str
    by: Hold | None = None
    link: str | None = None

    @property
    def frame(self) -> str | None:
        """The frame that holds it, "<object>.<link>"; None is the tool frame."""
        return f"{self.by.object}.{self.link}" if self.by else None

    def __str__(self) -> str:
        return f"{self.object}.{self.attachment}" + (f" by {self.frame}" if self.by else "")


def holds_of(held: Mapping[str, str], by: Mapping[str, str]) -> tuple[Hold, ...]:
    """Return the holds that two mappings describe, each after the one it depends on.

    Args:
        held: Object → attachment.
        by: Object → "<object>.<link>", for what is not held by the tool itself.

    Raises:
        UnknownNameError: `by` names an object that is not held.
        InputError: Objects hold each other in a circle, or `by` is not of that form.
    """
    found: dict[str, Hold] = {}
    for frame in by.values():
        owner, dot, link = str(frame).partition(".")
        if not (dot and link):
            raise InputError("not a link of an object", field="by", expected="<object>.<link>, e.g. stick.tip", got=repr(frame))
        if owner not in held:
            raise UnknownNameError("held object", owner, held, field="by")
    waiting = dict(held)
    while waiting:
        ready = [name for name in waiting if name not in by or by[name].partition(".")[0] in found]
        if not ready:
            raise InputError("objects hold each other in a circle", field="by", got=", ".join(sorted(waiting)))
        for name in ready:
            owner, _, link = by.get(name, "").partition(".")
            found[name] = Hold(name, waiting.pop(name), found[owner] if owner else None, link or None)
    return tuple(found.values())


def as_mappings(holds: Iterable[Hold]) -> tuple[dict[str, str], dict[str, str]]:
    """Return object → attachment, and object → holding frame for what the tool does not hold itself."""
    holds = tuple(holds)
    return {h.object: h.attachment for h in holds}, {h.object: h.frame for h in holds if h.frame is not None}
