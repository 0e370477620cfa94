from .furniture.catalogue import random_object, write_object
from .rooms.random_room import random_room
from .rooms.settings import RoomSettings
from .tasks import goals, random_task

__all__ = [
    "RoomSettings",
    "goals",
    "random_object",
    "random_room",
    "random_task",
    "write_object",
]
