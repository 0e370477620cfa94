"""Chores: long lists of steps, planned in a window that slides along them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import Planner, guarded
from vkc_pin.planning.settings import Settings, settings_for
from vkc_pin.planning.solver.solution import Iteration
from vkc_pin.planning.window import SlidingWindow
from vkc_pin.utils.arguments import whole
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.actions import compile_each_step
from vkc_pin.world.task.phases import summarize_phases
from vkc_pin.world.task.steps import Step, as_steps
from vkc_pin.world.task.terms import Term, check_terms_active

__all__ = ["plan_chore"]


def plan_chore(
    scene: Scene,
    steps: Sequence[Step],
    *,
    window: int = 2,
    initialization: str = "auto",
    options: Options | None = None,
    callback: Callable[[Iteration], None] | None = None,
    time_limit: float | None = None,
    effort: int | None = None,
    seed: int = 0,
    progress: bool = False,
    terms: Sequence[Term] = (),
    planner: Planner | None = None,
) -> Plan:
    """Plan many steps over several objects, each with the next ones in mind.

    What is done with one object, from taking hold of it on, is an action. Every `window` actions
    that follow one another are planned as one problem; the motion of the first of them is kept, and
    the window moves on by one, from the state in which that motion leaves robot and world. So no
    grasp and no place of the base is chosen from which the next action cannot be done. Should it
    come to that all the same, the last decision is given up, and planned anew with one more action
    in mind.

    Args:
        scene: Robot, objects and obstacles.
        steps: What should change in the world, in this order.
        window: How many actions are planned together, at least 1.
        initialization: As for `planner.plan`.
        options: As for `planner.plan`.
        callback: As for `planner.plan`.
        time_limit: As for `planner.plan`, for all steps together.
        effort: The same.
        seed: Of the random numbers.
        progress: As for `planner.plan`.
        terms: Own constraints and costs, as for `planner.plan`.
        planner: As for `planner.plan`.

    Returns:
        One plan of all steps, checked as a whole. If a step fails: of those before it, with the
        best motion there is of that one, and a note that names it. After Ctrl-C: of what was
        decided by then.

    Raises:
        InputError: A step names something that is not there, or cannot be done at its place in the
            list; the error names it.
    """
    settings = settings_for(
        scene,
        initialization=initialization,
        options=options,
        callback=callback,
        time_limit=time_limit,
        effort=effort,
        seed=seed,
        terms=terms,
    )
    window, asked = whole(window, "window", low=1), as_steps(steps)

    def run(settings: Settings) -> Plan:
        tasks = compile_each_step(scene, asked, settings.options)
        check_terms_active(
            settings.terms, [stretch for task in tasks for stretch in summarize_phases(task)]
        )
        through = dict.fromkeys(
            hold for task in tasks for hold in task.holds if hold.by is not None
        )
        return SlidingWindow(
            scene.with_approaches(through, stacklevel=5), asked, window, settings
        ).run()

    return guarded(run, settings, progress, planner)
