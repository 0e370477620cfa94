import types

from . import baselines, benchmarks, simulation, validation, visualization
from .datasets.check import DatasetCheck, check_dataset
from .datasets.dataset import Dataset
from .datasets.episode import Episode
from .datasets.generate import generate
from .datasets.recipes.recipe import Recipe, load_recipe
from .errors import BuildError, InputError, UnknownNameError, VkcError
from .importing.homes.home_import import ImportedHome, import_home
from .importing.objects.object_import import ImportedObject, import_object
from .importing.proposals.proposal import Proposal, Proposals
from .importing.proposals.propose import propose_attachments
from .importing.robots.doctor import Diagnosis, doctor
from .importing.robots.robot_import import ImportedRobot, import_robot
from .options import Options
from .planning.chain.chain import VirtualKinematicChain, consolidate
from .planning.chain.inversion import invert
from .planning.nlp.inspection import build
from .planning.nlp.problem import TrajectoryProblem
from .planning.plan import Plan
from .planning.planner import Planner, plan
from .planning.scene_check import ReachableAttachment, SceneCheck, check_scene
from .planning.solver.solution import Iteration
from .procedural.furniture.catalogue import random_object, write_object
from .procedural.rooms.random_room import random_room
from .procedural.rooms.settings import RoomSettings
from .procedural.tasks import goals, random_task
from .simulation.physics import Physics
from .simulation.result import SimulationResult
from .validation.report import Report, Violation
from .validation.validate import validate
from .world.models.articulated_object import ArticulatedObject, Attachment, Freedom, Latch
from .world.models.object_file import load_object
from .world.models.robot import Robot
from .world.models.robot_file import load_robot
from .world.scene.hold import Hold
from .world.scene.placed_object import PlacedObject
from .world.scene.scene import Scene, load_scene
from .world.task.formula import State
from .world.task.steps import Actuate, GoTo, Grasp, Place, Reach, Release, Touch
from .world.task.terms import Constraint, Cost
from .world.trajectory.phase_span import PhaseSpan
from .world.trajectory.trajectory import Trajectory

__version__: str
cpin: types.ModuleType

__all__ = [
    "Actuate",
    "ArticulatedObject",
    "Attachment",
    "BuildError",
    "Constraint",
    "Cost",
    "Dataset",
    "DatasetCheck",
    "Diagnosis",
    "Episode",
    "Freedom",
    "GoTo",
    "Grasp",
    "Hold",
    "ImportedHome",
    "ImportedObject",
    "ImportedRobot",
    "InputError",
    "Iteration",
    "Latch",
    "Options",
    "PhaseSpan",
    "Physics",
    "Place",
    "PlacedObject",
    "Plan",
    "Planner",
    "Proposal",
    "Proposals",
    "Reach",
    "ReachableAttachment",
    "Recipe",
    "Release",
    "Report",
    "Robot",
    "RoomSettings",
    "Scene",
    "SceneCheck",
    "SimulationResult",
    "State",
    "Touch",
    "Trajectory",
    "TrajectoryProblem",
    "UnknownNameError",
    "Violation",
    "VirtualKinematicChain",
    "VkcError",
    "__version__",
    "baselines",
    "benchmarks",
    "build",
    "check_dataset",
    "check_scene",
    "consolidate",
    "cpin",
    "doctor",
    "generate",
    "goals",
    "import_home",
    "import_object",
    "import_robot",
    "invert",
    "load_object",
    "load_recipe",
    "load_robot",
    "load_scene",
    "plan",
    "propose_attachments",
    "random_object",
    "random_room",
    "random_task",
    "simulation",
    "validate",
    "validation",
    "visualization",
    "write_object",
]
