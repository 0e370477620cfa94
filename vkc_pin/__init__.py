"""Whole-body planning for mobile manipulators on virtual kinematic chains."""

from importlib.metadata import PackageNotFoundError, version

from vkc_pin.chain.chain import VirtualKinematicChain, consolidate
from vkc_pin.chain.inversion import invert
from vkc_pin.errors import BuildError, InputError, UnknownNameError, VkcError
from vkc_pin.models.articulation import ArticulatedObject, Attachment, Freedom, Latch
from vkc_pin.models.object_file import load_object
from vkc_pin.models.robot import Robot
from vkc_pin.models.robot_file import load_robot
from vkc_pin.motion.trajectory import PhaseSpan, Trajectory
from vkc_pin.options import Options
from vkc_pin.planning.chore import plan_chore
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import Planner, plan
from vkc_pin.plotting import cards as _cards  # noqa: F401 - registers what notebooks show of a scene
from vkc_pin.program.inspection import build
from vkc_pin.program.problem import TrajectoryProblem
from vkc_pin.scene.hold import Hold
from vkc_pin.scene.placed import PlacedObject
from vkc_pin.scene.scene import Scene, load_scene
from vkc_pin.solver.solution import Iteration
from vkc_pin.task.formula import State
from vkc_pin.task.steps import Actuate, GoTo, Grasp, Place, Reach, Release, Touch
from vkc_pin.task.terms import Constraint, Cost
from vkc_pin.validation.report import Report, Violation
from vkc_pin.validation.validate import validate

try:
    __version__ = version("vkc-pin")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

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
    "Hold",
    "InputError",
    "Iteration",
    "Latch",
    "Options",
    "PhaseSpan",
    "Place",
    "PlacedObject",
    "Plan",
    "Planner",
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
