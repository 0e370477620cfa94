from .furniture.catalogue import random_object, write_object
from .rooms.random_room import RoomSettings, random_room
from .tasks import goals, random_task

__all__ = [
    "RoomSettings",
    "goals",
    "random_object",
    "random_room",
    "random_task",
    "write_object",
]
