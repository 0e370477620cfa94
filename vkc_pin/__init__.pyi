import types

from . import (
    datasets,
    experiments,
    importing,
    procedural,
    simulation,
    validation,
    visualization,
)
from .errors import BuildError, InputError, UnknownNameError, VkcError
from .importing.mujoco_scene import scene_from_mujoco
from .options import Options
from .planning.chain.chain import VirtualKinematicChain, consolidate, invert
from .planning.inverse_kinematics import inverse_kinematics
from .planning.nlp.inspection import build
from .planning.nlp.problem import TrajectoryProblem
from .planning.plan import Plan
from .planning.planner import Planner
from .planning.prepare import PreparedTask, plan, prepare
from .planning.replan import replan
from .planning.scene_check import ReachableAttachment, SceneCheck, check_scene
from .planning.solver.solution import Iteration
from .simulation.physics import Physics
from .simulation.result import SimulationResult
from .validation.report import Report, Violation
from .validation.tolerances import Tolerances
from .validation.validate import validate
from .world.files.points import PointFile, read_points
from .world.models.articulated_object import ArticulatedObject, Attachment, Freedom, Latch
from .world.models.camera import Camera
from .world.models.object_file import load_object
from .world.models.robot import Robot
from .world.models.robot_file import load_robot
from .world.scene.hold import Hold
from .world.scene.joint_estimation import JointEstimate, estimate_joint
from .world.scene.measured_points import PointCounts
from .world.scene.placed_object import PlacedObject
from .world.scene.scene import Scene, load_scene
from .world.task.steps import Actuate, Configure, GoTo, Grasp, Place, Reach, Release, Touch
from .world.task.terms import Constraint, Cost, State
from .world.task.views import keep_in_view, prefer_in_view
from .world.trajectory.phase_span import PhaseSpan
from .world.trajectory.trajectory import Trajectory

__version__: str
cpin: types.ModuleType

__all__ = [
    "Actuate",
    "ArticulatedObject",
    "Attachment",
    "BuildError",
    "Camera",
    "Configure",
    "Constraint",
    "Cost",
    "Freedom",
    "GoTo",
    "Grasp",
    "Hold",
    "InputError",
    "Iteration",
    "JointEstimate",
    "Latch",
    "Options",
    "PhaseSpan",
    "Physics",
    "Place",
    "PlacedObject",
    "Plan",
    "Planner",
    "PointCounts",
    "PointFile",
    "PreparedTask",
    "Reach",
    "ReachableAttachment",
    "Release",
    "Report",
    "Robot",
    "Scene",
    "SceneCheck",
    "SimulationResult",
    "State",
    "Tolerances",
    "Touch",
    "Trajectory",
    "TrajectoryProblem",
    "UnknownNameError",
    "Violation",
    "VirtualKinematicChain",
    "VkcError",
    "__version__",
    "build",
    "check_scene",
    "consolidate",
    "cpin",
    "datasets",
    "estimate_joint",
    "experiments",
    "importing",
    "inverse_kinematics",
    "invert",
    "keep_in_view",
    "load_object",
    "load_robot",
    "load_scene",
    "plan",
    "prefer_in_view",
    "prepare",
    "procedural",
    "read_points",
    "replan",
    "scene_from_mujoco",
    "simulation",
    "validate",
    "validation",
    "visualization",
]
