"""Whole-body planning for mobile manipulators on virtual kinematic chains."""

from vkc_pin import cards as _cards  # noqa: F401 - registers what notebooks show of a scene
from vkc_pin.articulation import ArticulatedObject, Attachment, Freedom, Latch
from vkc_pin.chain import VirtualKinematicChain, consolidate
from vkc_pin.chore import plan_chore
from vkc_pin.errors import BuildError, InputError, UnknownNameError, VkcError
from vkc_pin.formula import State
from vkc_pin.inversion import invert
from vkc_pin.object_file import load_object
from vkc_pin.options import Options
from vkc_pin.placed import PlacedObject
from vkc_pin.plan import Plan
from vkc_pin.planner import plan
from vkc_pin.problem import TrajectoryProblem, build
from vkc_pin.report import Report, Violation
from vkc_pin.robot import Robot
from vkc_pin.robot_file import load_robot
from vkc_pin.scene import Scene, load_scene
from vkc_pin.solution import Iteration
from vkc_pin.steps import Actuate, GoTo, Grasp, Place, Reach, Release, Touch
from vkc_pin.terms import Constraint, Cost
from vkc_pin.trajectory import PhaseSpan, Trajectory
from vkc_pin.validation import validate
from vkc_pin.version import __version__

__all__ = [
    "Actuate",
    "ArticulatedObject",
    "Attachment",
    "BuildError",
    "Constraint",
    "Cost",
    "Freedom",
    "GoTo",
    "Grasp",
    "InputError",
    "Iteration",
    "Latch",
    "Options",
    "PhaseSpan",
    "Place",
    "PlacedObject",
    "Plan",
    "Reach",
    "Release",
    "Report",
    "Robot",
    "Scene",
    "State",
    "Touch",
    "Trajectory",
    "TrajectoryProblem",
    "UnknownNameError",
    "Violation",
    "VirtualKinematicChain",
    "VkcError",
    "__version__",
    "build",
    "consolidate",
    "invert",
    "load_object",
    "load_robot",
    "load_scene",
    "plan",
    "plan_chore",
    "validate",
]
