"""Plan: what planning returns, with its report, and how it is saved, loaded, shown and exported."""

from __future__ import annotations

import io
import json
import os
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vkc_pin.arguments import file_path
from vkc_pin.errors import InputError
from vkc_pin.files.resources import folder
from vkc_pin.files.writing import write_atomically
from vkc_pin.motion.trajectory import Trajectory
from vkc_pin.motion.world import units_of
from vkc_pin.options import Options
from vkc_pin.plotting import plots as plotting
from vkc_pin.plotting.cards import motion_html
from vkc_pin.scene.scene import Scene
from vkc_pin.task.steps import Step, step_from_dict, step_to_dict
from vkc_pin.task.terms import Term, term_from_dict, term_to_dict
from vkc_pin.validation.report import Report
from vkc_pin.visualization import viewer as visualization

if TYPE_CHECKING:
    import meshcat

__all__ = ["Plan"]

FORMAT = 1


def _folder_to_data(scene_folder: Path, plan: Path) -> dict[str, str]:
    """Return where a scene's folder is: in the package, or seen from the plan's file and absolutely."""
    there = scene_folder.resolve()
    if there == folder("scenes").resolve():
        return {"package": "scenes"}
    return {"relative": os.path.relpath(there, plan.resolve().parent), "absolute": str(there)}


def _folder_from_data(data: Mapping[str, str], plan: Path) -> Path:
    if "package" in data:
        return folder(data["package"])
    beside = plan.resolve().parent / data["relative"]
    return beside if beside.is_dir() else Path(data["absolute"])


@dataclass(frozen=True)
class Plan:
    """A motion and everything there is to say about it.

    Attributes:
        scene: The scene it was planned in.
        steps: What was asked for.
        options: How it was planned.
        trajectory: The motion; if planning failed, the best there was.
        validation: What the independent check says of it.
        status: "success", or why not: "infeasible", "not converged", "time limit", "effort spent", "interrupted", "rejected";
            plans of the baselines name the stage that failed.
        metrics: planning_time [s], build_time [s], base_effort [m], base_effort_l1 [m], arm_effort [rad], clearance [m],
            closure_error [m], duration [s], iterations, rounds, effort [units, see `planner.plan`], and the split time_coal,
            time_casadi, time_ipopt, time_initialization, time_validation [s].
        seed: Of the random numbers.
        initialization: Which seed trajectory it came from.
        history: One row per round of the solver.
        terms: The user's own constraints and costs, with their expressions as data.
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

    @property
    def success(self) -> bool:
        """Whether the independent validation found nothing wrong with a motion that does what was asked for."""
        return self.validation.ok and self.status == "success"

    def report(self) -> str:
        """Return what came out, for people: success or every violated constraint, efforts, clearance, times."""
        m = self.metrics
        lines = [
            f"{self.scene.name}: {'success' if self.success else f'FAILED, {self.status}'} — "
            + ", ".join(p.name for p in self.trajectory.phases),
            f"  motion      {m['duration']:.1f} s, {len(self.trajectory.times)} waypoints",
            f"  effort      base {m['base_effort']:.2f} m (|dx|+|dy| {m['base_effort_l1']:.2f} m), arm {m['arm_effort']:.2f} rad",
            f"  clearance   {1e3 * m['clearance']:.1f} mm at the closest, closure within {1e3 * m['closure_error']:.3f} mm",
            f"  planning    {m['planning_time']:.3f} s after {m['build_time']:.2f} s of symbolic build: "
            f"seeds {m['time_initialization']:.3f}, coal {m['time_coal']:.3f}, CasADi {m['time_casadi']:.3f}, "
            f"Ipopt {m['time_ipopt']:.3f}, validation {m['time_validation']:.3f}; "
            f"{int(m['rounds'])} rounds, {int(m['iterations'])} Ipopt iterations, "
            f"effort {int(m.get('effort', 0))}, seed {self.initialization}",
            *(f"  {line}" for line in self.validation.lines()),
        ]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return trajectory, metrics and report as plain data, e.g. for JSON; distances that do not exist are None."""
        finite = {key: value if np.isfinite(value) else None for key, value in self.metrics.items()}
        return {
            "scene": self.scene.name,
            "steps": [step_to_dict(step) for step in self.steps],
            "success": self.success,
            "status": self.status,
            "metrics": finite,
            "seed": self.seed,
            "initialization": self.initialization,
            "violations": [asdict(violation) for violation in self.validation.violations],
            "notes": list(self.validation.notes),
            "trajectory": self.trajectory.to_dict(),
        }

    def to_json(self, path: str | Path) -> Path:
        """Write `to_dict` as JSON, whole or not at all; return the path. `Trajectory.from_json` reads the motion."""
        return write_atomically(path, (json.dumps(self.to_dict(), indent=1) + "\n").encode("utf-8"))

    def to_csv(self, path: str | Path, **options: Any) -> Path:
        """Write the motion as a table with a line a waypoint, and a unit to every column; see `tables.write_csv`."""
        return self.trajectory.to_csv(path, **{"units": units_of(self.scene), **options})

    def to_ros(self, **options: Any) -> dict[str, Any]:
        """Return the motion as plain data with the fields of ROS' `trajectory_msgs/JointTrajectory`; see `ros.to_ros`."""
        return self.trajectory.to_ros(**options)

    def __repr__(self) -> str:
        m = self.metrics
        return f"<Plan {self.status}: base {m['base_effort']:.2f} m, arm {m['arm_effort']:.2f} rad, {m['planning_time']:.2f} s>"

    def _repr_html_(self) -> str:
        return motion_html(self)

    def show(self, **options: Any) -> Any:
        """Show the motion with meshcat: inline in a notebook, otherwise in the browser; see `visualization.show`."""
        return visualization.show(self, **options)

    def animate(self, viewer: meshcat.Visualizer | None = None) -> Any:
        """Put the motion into a meshcat viewer with play, pause and a time slider; return the viewer."""
        return visualization.animate(self, viewer)

    def to_html(self, path: str | Path) -> Path:
        """Write one self-contained page with the animation; return its path."""
        return visualization.to_html(self, path)

    def plot(self, path: str | Path | None = None) -> Any:
        """Draw joints, velocities, clearance and a top view; see `plotting.plot`."""
        return plotting.plot(self, path)

    def save(self, path: str | Path) -> Path:
        """Save it, with its scene, steps, options and report, as an .npz file without pickles; return the path.

        The scene's description is in the file; the meshes and URDFs it names are not. A scene of the package finds them
        in whatever installation loads the plan; for others the file keeps where their folder is, seen from the plan and
        absolutely, so that plan and scene can move together and the plan alone.
        """
        about = {
            "format": FORMAT,
            "scene": self.scene.document,
            "folder": _folder_to_data(self.scene.folder, file_path(path, "path")),
            "steps": [step_to_dict(step) for step in self.steps],
            "options": asdict(self.options),
            "trajectory": {k: v for k, v in self.trajectory.to_dict().items() if k not in ("times", "positions")},
            "validation": self.validation.to_dict(),
            "status": self.status,
            "metrics": dict(self.metrics),
            "seed": self.seed,
            "initialization": self.initialization,
            "history": [dict(row) for row in self.history],
            "terms": [term_to_dict(term) for term in self.terms],
        }
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer, about=np.array(json.dumps(about)), times=self.trajectory.times, positions=self.trajectory.positions
        )
        return write_atomically(path, buffer.getvalue())

    @classmethod
    def load(cls, path: str | Path) -> Plan:
        """Return the plan that `save` wrote to `path`.

        Raises:
            InputError: The file is missing, damaged, no plan, or of a newer format, or what its scene names is not there.
        """
        path = file_path(path, "path", "a saved plan (.npz)")
        if not path.is_file():
            raise InputError("no such file", file=path, expected="a saved plan (.npz)")
        try:
            return cls._read(path)
        except InputError as error:
            if error.file is not None:
                raise
            got, expected = error.got, error.expected
            raise InputError(error.problem, file=path, field=error.field, expected=expected, got=got) from error
        except (ValueError, LookupError, TypeError, AttributeError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise InputError("not a saved plan", file=path, expected="a file written by Plan.save", got=str(error)) from error

    @classmethod
    def _read(cls, path: Path) -> Plan:
        with np.load(path, allow_pickle=False) as archive:
            about = json.loads(str(archive["about"]))
            if about.get("format") != FORMAT:
                raise InputError("unknown format", file=path, field="format", expected=FORMAT, got=about.get("format"))
            trajectory = {**about["trajectory"], "times": archive["times"], "positions": archive["positions"]}
        return cls(
            scene=Scene.from_document(about["scene"], _folder_from_data(about["folder"], path)),
            steps=tuple(step_from_dict(step) for step in about["steps"]),
            options=Options(**about["options"]),
            trajectory=Trajectory.from_dict(trajectory),
            validation=Report.from_dict(about["validation"]),
            status=about["status"],
            metrics=about["metrics"],
            seed=about["seed"],
            initialization=about["initialization"],
            history=tuple(about["history"]),
            terms=tuple(term_from_dict(term) for term in about.get("terms", ())),
        )
