"""Plan: what planning returns, with its report, and how it is saved, loaded, shown and exported."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

import numpy as np

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.options import Options
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.report import Report
from vkc_pin.validation.validate import check_arguments, validate
from vkc_pin.world.files.resources import file_path
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.actions import compile_each_step
from vkc_pin.world.task.steps import Step, step_from_dict, step_to_dict
from vkc_pin.world.task.terms import Term, term_from_dict, term_to_dict
from vkc_pin.world.trajectory.formats.archives import (
    read_archive,
    resolve_folder,
    serialize_folder,
    write_archive,
)
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import compute_final_scene, find_coordinate_units

if TYPE_CHECKING:
    import meshcat

    from vkc_pin.simulation.result import SimulationResult

__all__ = ["Plan"]

T = TypeVar("T")


@dataclass(frozen=True)
class Plan:
    """A motion and everything there is to say about it.

    Attributes:
        scene: The scene it was planned in.
        steps: What was asked for.
        options: How it was planned.
        trajectory: The motion; if planning failed, the best there was.
        validation: What the independent check says of it. For a loaded plan it is made when it is
            first asked for.
        status: "success", "infeasible", "not converged", "time limit", "effort spent",
            "interrupted", "rejected"; of baselines that fail, the stage.
        metrics: planning_time [s], build_time [s], base_effort [m], base_effort_l1 [m], arm_effort
            [rad], clearance [m], closure_error [m], duration [s], torque [share of what a motor
            has], iterations, rounds, effort [units, see `planner.plan`], and what it was spent on:
            time_initialization, _coal, _casadi, _ipopt, _retiming, _validation [s].
        seed, initialization: Of the random numbers; which seed trajectory it came from.
        history: One row per round of the solver.
        terms: The user's own constraints and costs, with their expressions as data.
        claimed: What the file says that a plan was loaded from, on which nothing here relies; else
            None.
    """

    scene: Scene
    steps: tuple[Step, ...]
    options: Options
    trajectory: Trajectory
    validation: Report
    status: str
    metrics: Mapping[str, float]
    seed: int = 0
    initialization: str = ""
    history: Sequence[Mapping[str, float]] = field(default_factory=tuple)
    terms: tuple[Term, ...] = ()
    claimed: Report | None = field(default=None, repr=False, compare=False)

    @property
    def success(self) -> bool:
        """Whether the independent validation found nothing wrong with a motion that does what was asked for."""
        return self.validation.ok and self.status == "success"

    def end_scene(self) -> Scene:
        """Return the scene at the end of the motion, to plan on from: robot, objects and what is held as it leaves them.

        Raises:
            InputError: It is no success, so that nothing ends.
        """
        if not self.success:
            raise InputError(
                "this plan is no success",
                field="end_scene",
                expected="a motion that is valid",
                got=self.status,
            )
        after = compile_each_step(self.scene, self.steps, self.options)[-1].after
        return compute_final_scene(self.scene, self.trajectory, after)

    def simulate(self, **options: Any) -> SimulationResult:
        """Execute the motion in physics, with masses and servos; see `simulation.simulate`. Needs the extra `sim`."""
        from vkc_pin.simulation.execution import simulate

        return simulate(self.scene, self.steps, self.trajectory, **options)

    def contradictions(self) -> list[str]:
        """Return what the file that the plan was loaded from says otherwise than the check of its motion, one line each."""
        return [] if self.claimed is None else self.validation.contradictions(self.claimed)

    def report(self) -> str:
        """Return what came out, for people: success or what is violated (the first twelve), efforts, clearance, times."""
        m = self.metrics
        lines = [
            f"{self.scene.name}: {'success' if self.success else f'FAILED, {self.status}'} — "
            + ", ".join(p.name for p in self.trajectory.phases),
            f"  motion      {m['duration']:.1f} s, {len(self.trajectory.times)} waypoints",
            *(f"  {line}" for line in self.validation.timing()),
            f"  effort      base {m['base_effort']:.2f} m (|dx|+|dy| {m['base_effort_l1']:.2f} m), arm {m['arm_effort']:.2f} rad",
            f"  clearance   {1e3 * m['clearance']:.1f} mm at the closest, closure within {1e3 * m['closure_error']:.3f} mm",
            f"  planning    {m['planning_time']:.3f} s after {m['build_time']:.2f} s of symbolic build: "
            f"seeds {m['time_initialization']:.3f}, coal {m['time_coal']:.3f}, CasADi {m['time_casadi']:.3f}, "
            f"Ipopt {m['time_ipopt']:.3f}, validation {m['time_validation']:.3f}; "
            f"{int(m['rounds'])} rounds, {int(m['iterations'])} Ipopt iterations, "
            f"effort {int(m.get('effort', 0))}, seed {self.initialization}",
            *(
                f"  {line}"
                for line in self.validation.by_phase(self.trajectory)
                if len(self.steps) > 1
            ),
            *(f"  {line}" for line in self.validation.lines()),
        ]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return trajectory, metrics and report as plain data, e.g. for JSON; distances that do not exist are None."""
        return {
            "scene": self.scene.name,
            "steps": [step_to_dict(step) for step in self.steps],
            "success": self.success,
            "status": self.status,
            "metrics": {
                key: value if np.isfinite(value) else None for key, value in self.metrics.items()
            },
            "seed": self.seed,
            "initialization": self.initialization,
            "violations": [asdict(violation) for violation in self.validation.violations],
            "notes": list(self.validation.notes),
            "bounds": [asdict(bound) for bound in self.validation.bounds],
            "remarks": list(self.validation.remarks),
            "exemptions": [asdict(exemption) for exemption in self.validation.exemptions],
            "trajectory": self.trajectory.to_dict(),
        }

    def to_json(self, path: str | Path) -> Path:
        """Write `to_dict` as JSON, whole or not at all; return the path. `Trajectory.from_json` reads the motion."""
        return write_atomically(path, (json.dumps(self.to_dict(), indent=1) + "\n").encode("utf-8"))

    def to_csv(self, path: str | Path, **options: Any) -> Path:
        """Write the motion as a table with a line a waypoint, and a unit to every column; see `tables.write_csv`."""
        return self.trajectory.to_csv(
            path, **{"units": find_coordinate_units(self.scene), **options}
        )

    def to_ros(self, **options: Any) -> dict[str, Any]:
        """Return the motion as plain data with the fields of ROS' `trajectory_msgs/JointTrajectory`; see `ros.to_ros`."""
        return self.trajectory.to_ros(**options)

    def to_rosbag(self, path: str | Path, **options: Any) -> Path:
        """Write a recording of ROS 2 into a new folder; see `rosbag.write_rosbag`. Needs the extra `ros`."""
        return self.trajectory.to_rosbag(path, **options)

    def __repr__(self) -> str:
        m = self.metrics
        return f"<Plan {self.status}: base {m['base_effort']:.2f} m, arm {m['arm_effort']:.2f} rad, {m['planning_time']:.2f} s>"

    def _repr_html_(self) -> str:
        from vkc_pin.visualization.plots.notebook_cards import motion_html

        return motion_html(self)

    def show(self, **options: Any) -> Any:
        """Show the motion with meshcat: inline in a notebook, otherwise in the browser; see `visualization.show`."""
        from vkc_pin.visualization.viewer import show

        return show(self, **options)

    def animate(self, viewer: meshcat.Visualizer | None = None) -> Any:
        """Put the motion into a meshcat viewer with play, pause and a time slider; return the viewer."""
        from vkc_pin.visualization.viewer import animate

        return animate(self, viewer)

    def to_html(self, path: str | Path) -> Path:
        """Write one self-contained page with the animation; return its path."""
        from vkc_pin.visualization.viewer import to_html

        return to_html(self, path)

    def plot(self, path: str | Path | None = None) -> Any:
        """Draw joints, velocities, clearance and a top view; see `plotting.plot`."""
        from vkc_pin.visualization.plots.plots import plot

        return plot(self, path)

    def save(self, path: str | Path) -> Path:
        """Save it, with its scene, steps, options and report, as an .npz file without pickles; return the path.

        The scene's description is in the file; the meshes and URDFs it names are not. A scene of
        the package finds them in whatever installation loads the plan; for others the file keeps
        where their folder is, seen from the plan and absolutely, so that plan and scene can move
        together and the plan alone.
        """
        about = {
            "scene": self.scene.document,
            "folder": serialize_folder(self.scene.folder, file_path(path, "path")),
            "steps": [step_to_dict(step) for step in self.steps],
            "options": asdict(self.options),
            "trajectory": self.trajectory.to_dict(),
            "validation": self.validation.to_dict(),
            "status": self.status,
            "metrics": {**self.metrics, **_measured(self)},
            "seed": self.seed,
            "initialization": self.initialization,
            "history": [dict(row) for row in self.history],
            "terms": [term_to_dict(term) for term in self.terms],
        }
        return write_archive(path, about)

    @classmethod
    def load(cls, path: str | Path, *, check: bool = False) -> Plan:
        """Return the plan that `save` wrote to `path`.

        What the file says of its motion is kept as `claimed`, and not relied on: `validation`,
        `success`, `status` and `metrics` are those of a check that is made when they are first
        asked for, which takes as long as the check after planning. The file's are only what
        planning took, and what it found out about the task: the notes, and why a task is
        infeasible.

        Args:
            path: The file.
            check: Check the motion at once; then not even that is the file's.

        Raises:
            InputError: The file is missing, damaged, no plan, or of another format, something in it
                does not fit, the motion is none of its scene's robot and objects, or what the scene
                names is not there.
        """
        path = file_path(path, "path", "a saved plan (.npz)")
        about, arrays = read_archive(path)
        try:
            plan = cls._made_of(about, arrays, path, _checked if check else _recalled)
            check_arguments(plan.scene, plan.steps, plan.trajectory, plan.terms)
            if check:
                plan.validation  # noqa: B018 - makes it
        except InputError as error:
            if error.file is not None:
                raise
            raise InputError(
                error.problem, file=path, field=error.field, expected=error.expected, got=error.got
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
            raise InputError(
                "not a saved plan",
                file=path,
                expected="a file written by Plan.save",
                got=str(error),
            ) from error
        return plan

    @classmethod
    def _made_of(
        cls,
        about: Mapping[str, Any],
        arrays: Mapping[str, Floats],
        path: Path,
        validation: Callable[[Plan], Report],
    ) -> Plan:
        trajectory, status = (
            Trajectory.from_dict({**about["trajectory"], **arrays}),
            about["status"],
        )
        claimed, metrics = Report.from_dict(about["validation"]), about["metrics"]
        for name, value in {**trajectory.metrics(), **claimed.measures()}.items():
            if metrics[name] != value and not abs(metrics[name] - value) <= 1e-9 * max(
                1.0, abs(value)
            ):
                raise InputError(
                    "not that of motion and report",
                    field=f"metrics.{name}",
                    expected=value,
                    got=metrics[name],
                )
        for name in about["options"]:
            if name not in (options := [item.name for item in fields(Options)]):
                raise UnknownNameError("option", name, options, field=f"options.{name}")
        return cls(
            scene=Scene.from_document(about["scene"], resolve_folder(about["folder"], path)),
            steps=tuple(step_from_dict(step) for step in about["steps"]),
            options=_saved(about["options"]),
            trajectory=trajectory,
            validation=cast(Report, validation),
            status=cast(str, lambda plan: "success" if plan.validation.ok else "rejected")
            if status == "success"
            else status,
            metrics=cast(Mapping[str, float], lambda plan: {**metrics, **_measured(plan)}),
            seed=about["seed"],
            initialization=about["initialization"],
            history=tuple(about["history"]),
            terms=tuple(term_from_dict(term) for term in about["terms"]),
            claimed=claimed,
        )


def _checked(plan: Plan) -> Report:
    """Return what validation says of a loaded plan."""
    return validate(plan.scene, plan.steps, plan.trajectory, plan.options, plan.terms)


def _recalled(plan: Plan) -> Report:
    """Return the same with what its file says of the task."""
    report, claimed = _checked(plan), plan.claimed
    if claimed is None or report.ok:
        return report
    report = replace(report, notes=claimed.notes)
    return (
        report.with_reasons(claimed.violations or report.violations)
        if vars(plan)["status"] == "infeasible"
        else report
    )


def _measured(plan: Plan) -> dict[str, float]:
    """Return the metrics of a plan but for what planning took."""
    return {**plan.trajectory.metrics(), **plan.validation.measures()}


class _OnDemand(Generic[T]):
    """A field that may be given as a function of the plan, which is called when the field is first asked for."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __get__(self, plan: Plan | None, owner: type[Plan]) -> T:
        if plan is None:
            raise AttributeError(self.name)
        value = vars(plan)[self.name]
        if callable(value):
            value = vars(plan)[self.name] = value(plan)
        return cast(T, value)

    def __set__(self, plan: Plan, value: T | Callable[[Plan], T]) -> None:
        vars(plan)[self.name] = value


for _name in ("validation", "status", "metrics"):
    setattr(Plan, _name, _OnDemand(_name))


def _saved(options: Mapping[str, Any]) -> Options:
    """Return options that were saved: those without a clearance between the robot's links had one for all pairs."""
    return Options(
        **{**({"self_distance": options["dist_safe"]} if "dist_safe" in options else {}), **options}
    )
