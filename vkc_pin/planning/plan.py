"""The result of planning, its statistics, and how it is saved, loaded, shown and exported."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.stopping import brake, list_steps_of_stop
from vkc_pin.utils.arguments import check_bool, check_instance, check_number
from vkc_pin.utils.arrays import replace_infinite
from vkc_pin.validation.report import Report
from vkc_pin.validation.validate import check_arguments, validate
from vkc_pin.world.files.documents import Document, parse_document
from vkc_pin.world.files.resources import check_path
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.actions import compile_each_step
from vkc_pin.world.task.steps import Configure, Step, step_from_dict, step_to_dict
from vkc_pin.world.task.terms import Term, term_from_dict, term_to_dict
from vkc_pin.world.trajectory.formats.archives import (
    read_archive,
    resolve_folder,
    serialize_folder,
    write_archive,
)
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import (
    compute_final_scene,
    compute_frame_placement,
    compute_scene_at,
    find_coordinate_units,
)

if TYPE_CHECKING:
    import meshcat
    import pinocchio as pin

    from vkc_pin.planning.plan_schema import PlanSchema
    from vkc_pin.simulation.mujoco_motion import MujocoMotion
    from vkc_pin.simulation.result import SimulationResult


PlanStatus = Literal[
    "success",
    "infeasible",
    "not converged",
    "time limit",
    "evaluation limit",
    "interrupted",
    "rejected",
]
"""How planning ended. Other planners have words of their own, see `Plan.status`."""

STAGES = ("initialization", "coal", "casadi", "ipopt", "retiming", "validation")
"""Stages of planning whose times are measured."""

_SUMMARIZED = ("initialization", "coal", "casadi", "ipopt", "validation")  # stages with times


@dataclass(frozen=True)
class PlanningStatistics:
    """Times and counts of planning.

    Attributes:
        planning_time: Total time without building symbolic programs [s].
        build_time: Time for building symbolic programs [s].
        iterations: Iterations of Ipopt.
        rounds: Rounds of the solver.
        evaluations: Evaluated configurations, see `Budget`.
        initialization_time: Time for initial guesses [s].
        coal_time: Time for distances [s].
        casadi_time: Time for evaluating symbolic functions [s].
        ipopt_time: Time inside Ipopt [s].
        retiming_time: Time for retiming [s].
        validation_time: Time for validation [s].
        following_time: Time in which the arm of a baseline follows the base [s].
    """

    planning_time: float = 0.0
    build_time: float = 0.0
    iterations: int = 0
    rounds: int = 0
    evaluations: int = 0
    initialization_time: float = 0.0
    coal_time: float = 0.0
    casadi_time: float = 0.0
    ipopt_time: float = 0.0
    retiming_time: float = 0.0
    validation_time: float = 0.0
    following_time: float = 0.0

    def __add__(self, other: PlanningStatistics) -> PlanningStatistics:
        mine, theirs = vars(self), vars(other)
        return PlanningStatistics(**{name: mine[name] + theirs[name] for name in mine})

    def with_times(self, times: Mapping[str, float]) -> PlanningStatistics:
        """Return the statistics with the times of some of `STAGES` [s]."""
        fields: dict[str, Any] = {f"{name}_time": value for name, value in times.items()}
        return replace(self, **fields)

    def to_metrics(self) -> dict[str, float]:
        """Return the statistics by the names in records of benchmarks."""
        times = {f"time_{stage}": float(getattr(self, f"{stage}_time")) for stage in STAGES}
        if self.following_time:
            times["time_following"] = self.following_time
        counts = {
            "iterations": float(self.iterations),
            "rounds": float(self.rounds),
            "evaluations": float(self.evaluations),
        }
        return {
            "planning_time": self.planning_time,
            "build_time": self.build_time,
            **counts,
            **times,
        }

    @classmethod
    def from_metrics(cls, metrics: Mapping[str, float]) -> PlanningStatistics:
        """Return the statistics that `to_metrics` returned; missing names count as 0."""
        stages = (*STAGES, "following")
        times = {f"{stage}_time": float(metrics.get(f"time_{stage}", 0.0)) for stage in stages}
        return cls(
            planning_time=float(metrics.get("planning_time", 0.0)),
            build_time=float(metrics.get("build_time", 0.0)),
            iterations=int(metrics.get("iterations", 0)),
            rounds=int(metrics.get("rounds", 0)),
            evaluations=int(metrics.get("evaluations", 0)),
            **times,
        )


@dataclass(frozen=True, eq=False)
class Plan:
    """A trajectory, its validation and the statistics of planning.

    Attributes:
        scene: Scene it was planned in.
        steps: Steps to be done.
        options: Options of planning.
        trajectory: The trajectory; after a failure, the best one found.
        report: Report of the independent validation.
        status: "success", "infeasible", "not converged", "time limit", "evaluation limit",
            "interrupted", "rejected"; of other planners that fail, a word of theirs.
        statistics: Times and counts of planning.
        seed: Random seed.
        initialization: Name of the initial guess it came from.
        is_optimized: Whether the trajectory is a solution of the nonlinear program. If not, it is
            the collision-free path of the initial guess itself, retimed: the solver found no
            solution from there.
        history: One row per round of the solver.
        terms: Constraints and costs of the user, with their expressions as data.
        claimed: Report in the file that the plan was loaded from; else None.
    """

    scene: Scene
    steps: tuple[Step, ...]
    options: Options
    trajectory: Trajectory
    report: Report
    status: str
    statistics: PlanningStatistics = field(default_factory=PlanningStatistics)
    seed: int = 0
    initialization: str = ""
    is_optimized: bool = True
    history: Sequence[Mapping[str, float]] = field(default_factory=tuple)
    terms: tuple[Term, ...] = ()
    claimed: Report | None = field(default=None, repr=False)

    @property
    def is_validated(self) -> bool:
        """Whether `report` is this program's own, and not its file's claim."""
        return self.report is not self.claimed

    @property
    def success(self) -> bool:
        """Whether the independent validation found no violation, and all steps are done."""
        return self.is_validated and self.report.ok and self.status == "success"

    @property
    def metrics(self) -> dict[str, float]:
        """Metrics of the trajectory, its validation and planning, by name.

        duration [s], base_path_length and base_path_length_l1 [m], arm_path_length [rad], clearance
        and closure_error [m], torque [share of the limit], and those of
        `PlanningStatistics.to_metrics`.
        """
        statistics = self.statistics.to_metrics()
        times = {name: statistics.pop(name) for name in ("planning_time", "build_time")}
        return {**times, **_measure(self), **statistics}

    def end_scene(self) -> Scene:
        """Return the scene at the end of the trajectory, from which planning can continue.

        Its start has the velocity with which the last step ends.

        Raises:
            InputError: The plan is no success.
        """
        self.check_success("end_scene")
        after = compile_each_step(self.scene, self.steps, self.options)[-1].after
        scene = compute_final_scene(self.scene, self.trajectory, after)
        motion = self.trajectory
        velocity = motion.velocity(motion.times[-1])[: motion.robot_size]
        return scene.with_start(velocity=velocity) if self.ends_in_motion else scene

    @property
    def ends_in_motion(self) -> bool:
        """Whether the last step ends with a velocity; see `Configure`."""
        last = self.steps[-1]
        return isinstance(last, Configure) and any(last.velocities.values())

    def scene_at(self, time: float) -> Scene:
        """Return the scene at a time of the motion [s], in which robot and objects are underway.

        The robot has the motion's velocity. While the gripper closes or opens, it is the scene
        before it did. To plan on from there, see `replan`.

        Raises:
            InputError: The time is outside the motion.
        """
        time = self.check_time(time)
        there = compute_scene_at(self.scene, self.trajectory, time)
        velocity = self.trajectory.velocity(time)[: self.trajectory.robot_size]
        return there.with_start(velocity=velocity)

    def stop(self, time: float, *, scene: Scene | None = None) -> Plan:
        """Return a motion that brakes on this one's path as hard as the limits allow.

        Those of velocities, accelerations and torques: jerks are not limited, since nothing is
        better than to brake.

        Args:
            time: When braking begins [s].
            scene: The world as it is at that time. Default: `scene_at(time)`.

        Returns:
            A plan whose motion counts from 0, validated in that scene: without success, something
            is touched before it is at rest, or a torque limit exceeded.

        Raises:
            InputError: This plan is no success, or the time is outside its motion.
        """
        self.check_success()
        time = self.check_time(time)
        now = self.scene_at(time) if scene is None else check_instance(scene, Scene, "scene")
        return self.check_stop(brake(self.scene, self.trajectory, time), now)

    def check_stop(self, motion: Trajectory, scene: Scene) -> Plan:
        """Return a braking motion, see `stopping.brake`, as a plan validated in a scene."""
        steps = list_steps_of_stop(self.scene, motion)
        options = replace(self.options, jerk_time=0.0)
        report = validate(scene, steps, motion, options)
        status = "success" if report.ok else "rejected"
        return Plan(scene, steps, options, motion, report, status, initialization="stop")

    def check_success(self, field: str = "plan") -> None:
        """Raise an `InputError` about a field unless the plan is a success."""
        if not self.success:
            problem, expected = "this plan is no success", "a motion that is valid"
            raise InputError(problem, field=field, expected=expected, got=self.status)

    def check_time(self, time: float) -> float:
        """Return a checked time of the motion [s].

        Raises:
            InputError: The time is outside the motion.
        """
        first, last = (float(self.trajectory.times[k]) for k in (0, -1))
        expected = f"a time from {first:g} to {last:g} s"
        return check_number(time, "time", expected, low=first, high=last)

    def simulate(self, **options: Any) -> SimulationResult:
        """Execute the trajectory in physics; see `simulation.simulate`. Extra: `sim`."""
        from vkc_pin.simulation.execution import simulate

        return simulate(self.scene, self.steps, self.trajectory, **options)

    def to_mujoco(
        self,
        model: Any,
        rate: float,
        *,
        data: Any = None,
        joints: Mapping[str, str] | None = None,
        robot_body: str | None = None,
    ) -> MujocoMotion:
        """Return the motion in the coordinates of a MuJoCo model. Extra: `sim`.

        Names and order are those of the model, such as one that `scene_from_mujoco` has read. The
        last sample is the goal. Joints of objects move as planned, in `qpos` alone.

        Args:
            model: The `mujoco.MjModel`.
            rate: Samples a second [Hz]; the end is one more.
            data: `mujoco.MjData` with the positions and controls of all that does not move;
                defaults to `model.qpos0` and 0.
            joints: Coordinate of the robot, finger, or "<object>.<joint>" → name of the model's
                joint, for names that differ.
            robot_body: Body that carries the robot; see `scene_from_mujoco`.

        Raises:
            UnknownNameError: A coordinate has no joint in the model, or `joints` names none.
            InputError: The plan is no success, MuJoCo is not installed, or the model has another
                robot, or has it elsewhere.
        """
        from vkc_pin.simulation.mujoco_motion import make_mujoco_motion

        self.check_success()
        return make_mujoco_motion(
            self.scene,
            self.trajectory,
            model,
            rate,
            data=data,
            joints=joints,
            robot_body=robot_body,
        )

    def pose(self, frame: str | None, time: float) -> pin.SE3:
        """Return where a frame is at a time of the motion, in the world frame.

        Args:
            frame: Frame of the robot (None: the tool frame), "<object>.<link>", or "<object>" for
                the base link of an object.
            time: From the first to the last of `trajectory.times` [s].

        Raises:
            UnknownNameError: There is no such frame.
            InputError: The time is outside the motion.
        """
        time = self.check_time(time)
        return compute_frame_placement(self.scene, self.trajectory, frame, time)

    def contradictions(self) -> list[str]:
        """Return contradictions of a loaded file's report to validation, one per line."""
        return [] if self.claimed is None else self.report.contradictions(self.claimed)

    def summary(self) -> str:
        """Return a summary: success or the first twelve violations, path lengths, times."""
        m, verdict = self.metrics, "success" if self.success else f"FAILED, {self.status}"
        stages = zip(("guesses", "coal", "CasADi", "Ipopt", "validation"), _SUMMARIZED, strict=True)
        times = ", ".join(f"{name} {m[f'time_{stage}']:.3f}" for name, stage in stages)
        lines = [
            f"{self.scene.name}: {verdict} — {', '.join(p.name for p in self.trajectory.phases)}",
            f"  motion      {m['duration']:.1f} s, {len(self.trajectory.times)} waypoints",
            *(_wrap(f"  {line}") for line in self.report.timing()),
            f"  path        base {m['base_path_length']:.2f} m "
            f"(|dx|+|dy| {m['base_path_length_l1']:.2f} m), arm {m['arm_path_length']:.2f} rad",
            f"  clearance   {1e3 * m['clearance']:.1f} mm at the closest, "
            f"closure within {1e3 * m['closure_error']:.3f} mm",
            _wrap(
                f"  planning    {m['planning_time']:.3f} s after {m['build_time']:.2f} s of "
                f"symbolic build: {times}; "
                f"{_count(int(m['rounds']), 'round')}, "
                f"{_count(int(m['iterations']), 'Ipopt iteration')}, "
                f"{_count(self.statistics.evaluations, 'evaluation')}, "
                f"initial guess {self.initialization}"
                + ("" if self.is_optimized else ", which is the motion, not optimized")
            ),
            *(f"  {line}" for line in self.report.by_phase(self.trajectory) if len(self.steps) > 1),
            *(f"  {line}" for line in self.report.lines()),
        ]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return trajectory, metrics and report as plain data; infinite numbers are None."""
        report = self.report.to_dict()
        shown = ("violations", "notes", "bounds", "remarks", "exemptions", "allowed")
        data = {
            "scene": self.scene.name,
            "steps": [step_to_dict(step) for step in self.steps],
            "success": self.success,
            "status": self.status,
            "metrics": self.metrics,
            "seed": self.seed,
            "initialization": self.initialization,
            "is_optimized": self.is_optimized,
            **{name: list(report[name]) for name in shown},
        }
        return {**replace_infinite(data), "trajectory": self.trajectory.to_dict()}

    def to_json(self, path: str | Path) -> Path:
        """Write `to_dict` as JSON; `Trajectory.from_json` reads the trajectory."""
        text = json.dumps(self.to_dict(), indent=1, allow_nan=False)
        return write_atomically(path, (text + "\n").encode("utf-8"))

    def to_csv(self, path: str | Path, **options: Any) -> Path:
        """Write the trajectory as a table with a row per waypoint; see `tables.write_csv`."""
        return self.trajectory.to_csv(
            path, **{"units": find_coordinate_units(self.scene), **options}
        )

    def to_ros(self, **options: Any) -> dict[str, Any]:
        """Return the trajectory as a `trajectory_msgs/JointTrajectory`; see `ros.to_ros`."""
        return self.trajectory.to_ros(**options)

    def to_rosbag(self, path: str | Path, **options: Any) -> Path:
        """Write a ROS 2 recording; see `rosbag.write_rosbag`. Requires the extra `ros`."""
        return self.trajectory.to_rosbag(path, **options)

    def __repr__(self) -> str:
        return (
            f"<Plan {self.status}: base {self.trajectory.base_path_length():.2f} m, "
            f"arm {self.trajectory.arm_path_length():.2f} rad, "
            f"{self.statistics.planning_time:.2f} s>"
        )

    def _repr_html_(self) -> str:
        from vkc_pin.visualization.plots.notebook_cards import motion_html

        return motion_html(self)

    def show(self, **options: Any) -> Any:
        """Show the trajectory with meshcat in a notebook or browser; see `visualization.show`."""
        from vkc_pin.visualization.viewer import show

        return show(self, **options)

    def animate(self, viewer: meshcat.Visualizer | None = None) -> Any:
        """Add the trajectory to a meshcat viewer with a time slider; return the viewer."""
        from vkc_pin.visualization.viewer import animate

        return animate(self, viewer)

    def to_html(self, path: str | Path) -> Path:
        """Write a self-contained page with the animation; return its path."""
        from vkc_pin.visualization.viewer import to_html

        return to_html(self, path)

    def plot(self, path: str | Path | None = None) -> Any:
        """Plot joints, velocities, clearance and a top view; see `visualization.plots`."""
        from vkc_pin.visualization.plots.plots import plot

        return plot(self, path)

    def save(self, path: str | Path) -> Path:
        """Save the plan with its scene and report as an .npz file without pickles; return its path.

        The scene's description is in the file, its meshes and URDFs are not. They are found in the
        package, or in the scene's folder, whose relative and absolute path are saved. So the plan
        can be moved alone or together with its scene.
        """
        about = {
            "scene": self.scene.document,
            "folder": serialize_folder(self.scene.folder, check_path(path, "path")),
            "steps": [step_to_dict(step) for step in self.steps],
            "options": asdict(self.options),
            "trajectory": self.trajectory.to_dict(),
            "validation": self.report.to_dict(),
            "status": self.status,
            "metrics": {**self.metrics, **_measure(self)},
            "seed": self.seed,
            "initialization": self.initialization,
            "is_optimized": self.is_optimized,
            "history": [dict(row) for row in self.history],
            "terms": [term_to_dict(term) for term in self.terms],
        }
        return write_archive(path, about)

    @classmethod
    def load(cls, path: str | Path, *, validate: bool = True) -> Plan:
        """Return the plan that `save` wrote.

        Report, status and metrics of the file are not trusted: the trajectory is validated again.
        Statistics, notes and the reasons of an infeasible task come from the file.

        Args:
            path: The file.
            validate: Validate the trajectory; otherwise the report is the file's claim, and
                `success` is False.

        Raises:
            InputError: The file is missing, damaged, inconsistent or of another format, or the
                scene has no such robot, object or file.
        """
        from vkc_pin.planning.plan_schema import PlanSchema  # takes 10 ms

        path = check_path(path, "path", "a saved plan (.npz)")
        saved = parse_document(Document(read_archive(path), path), PlanSchema)
        try:
            plan = cls._from_schema(saved, path)
            check_arguments(plan.scene, plan.steps, plan.trajectory, plan.terms)
            return _revalidate(plan) if check_bool(validate, "validate") else plan
        except InputError as error:
            if error.file is not None:
                raise
            problem, field = error.problem, error.field
            raise InputError(
                problem, file=path, field=field, expected=error.expected, got=error.got
            ) from error
        except (
            ValueError,
            LookupError,
            TypeError,
            AttributeError,
            OSError,
            OverflowError,
            RecursionError,
        ) as error:
            expected = "a file written by Plan.save"
            raise InputError(
                "not a saved plan", file=path, expected=expected, got=str(error)
            ) from error

    @classmethod
    def _from_schema(cls, saved: PlanSchema, path: Path) -> Plan:
        trajectory = saved.trajectory.make_trajectory()
        claimed = saved.validation
        metrics = saved.metrics.model_dump()
        for name, value in {**trajectory.metrics(), **claimed.measures()}.items():
            got, tolerance = metrics[name], 1e-9 * max(1.0, abs(value))
            if got != value and not abs(got - value) <= tolerance:
                problem = "not that of motion and report"
                raise InputError(problem, field=f"metrics.{name}", expected=value, got=got)
        if len(claimed.clearances) not in (0, len(trajectory.phases)):
            problem, expected = "wrong number", f"{len(trajectory.phases)}, one per phase"
            got = len(claimed.clearances)
            raise InputError(problem, field="validation.clearances", expected=expected, got=got)
        return cls(
            scene=Scene.from_document(saved.scene, resolve_folder(saved.folder, path)),
            steps=tuple(step_from_dict(step) for step in saved.steps),
            options=Options.from_dict(saved.options),
            trajectory=trajectory,
            report=claimed,
            status=saved.status,
            statistics=PlanningStatistics.from_metrics(metrics),
            seed=saved.seed,
            initialization=saved.initialization,
            is_optimized=saved.is_optimized,
            history=tuple(saved.history),
            terms=tuple(term_from_dict(term) for term in saved.terms),
            claimed=claimed,
        )


def _revalidate(plan: Plan) -> Plan:
    report = validate(plan.scene, plan.steps, plan.trajectory, plan.options, plan.terms)
    status, claimed = plan.status, plan.report
    if status == "success" and not report.ok:
        status = "rejected"
    if not report.ok:
        report = replace(report, notes=claimed.notes)
        if status == "infeasible":
            report = report.with_reasons(claimed.violations or report.violations)
    return replace(plan, report=report, status=status)


def _measure(plan: Plan) -> dict[str, float]:
    return {**plan.trajectory.metrics(), **plan.report.measures()}


_WIDTH = 100  # of a summary's lines, in columns: what a notebook shows without a break
_INDENT = 14  # of their text


def _wrap(line: str) -> str:
    """Return a line of the summary, broken between words if it is too wide."""
    return textwrap.fill(
        line,
        _WIDTH,
        subsequent_indent=" " * _INDENT,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
