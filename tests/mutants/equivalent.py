"""Faults that survived and are none: why no test could notice them."""
# ruff: noqa: E501

from __future__ import annotations

__all__ = ["EQUIVALENT"]

EQUIVALENT: dict[str, str] = {
    "validation/validate.py: for phase, riding in zip(self.trajectory.phases, self.samples.free.rides, strict=True): | constant: True → False": "`strict=True` asks whether two lists are equally long, which they are by the way they are made",
    'solver/loop.py: self.solution.timings["coal"] += time.perf_counter() - begin | dropped: self.solution.timings["coal"] += time.perf_counter() - begin → pass': "times and counts of what was done; no test says anything of wall time, and other parts of the same sum are above zero",
    "validation/touching.py: _DWELL = 1e-6  # [s] by which a rest may be too short | constant: 1e-6 → 2e-06": "a number against rounding; anything as small does",
    "validation/sweep.py: told = np.union1d(_least(at, distances), np.flatnonzero(distances < 0)) | comparison: < → <=": "both differ only where two numbers are the same to the last bit, or a distance is exactly zero, which is neither right nor wrong",
    "validation/touching.py: phases = zip(self.trajectory.phases, self.rides, strict=True) | constant: True → False": "`strict=True` asks whether two lists are equally long, which they are by the way they are made",
    "solver/between.py: return Between(merge(*parts), bool(np.all(found.distance >= np.minimum(CLOSE_ENOUGH, keep))), passed) | comparison: >= → >": "both differ only where two numbers are the same to the last bit, or a distance is exactly zero, which is neither right nor wrong",
    "solver/loop.py: if nearly and trial.rate > TOLERANCE:  # before, limits on rates only cost time | comparison: > → >=": "both differ only where two numbers are the same to the last bit, or a distance is exactly zero, which is neither right nor wrong",
    "program/merit.py: GROWTH = 4.0  # ratio of a weight to the one before, where it proved too small | constant: 4.0 → 8.0": "a setting of the search or of Ipopt: another one leads to motions that are as good, later or sooner",
    "chain/contacts.py: spend(min(found + 1, len(z))) | constant: 1 → 2": "times and counts of what was done; no test says anything of wall time, and other parts of the same sum are above zero",
    "chain/pose.py: _HALF_TURN = 1e-6  # of (2 cos(θ/2))² | constant: 1e-6 → 2e-06": "a number against rounding; anything as small does",
    'solver/subproblem.py: "ipopt.warm_start_bound_push": 1e-6, | constant: 1e-6 → 2e-06': "a setting of the search or of Ipopt: another one leads to motions that are as good, later or sooner",
    "validation/sweep.py: free = (np.minimum(todo.before, todo.after) >= -overlap) & (todo.before + todo.after < motion) | comparison: < → <=": "both differ only where two numbers are the same to the last bit, or a distance is exactly zero, which is neither right nor wrong",
    "solver/subproblem.py: self.forget() | dropped: self.forget() → pass": "a setting of the search or of Ipopt: another one leads to motions that are as good, later or sooner",
    'solver/subproblem.py: "ipopt.warm_start_slack_bound_frac": 1e-6, | constant: 1e-6 → 2e-06': "a setting of the search or of Ipopt: another one leads to motions that are as good, later or sooner",
    'solver/subproblem.py: "ipopt.mu_init": 1.0, | constant: 1.0 → 2.0': "a setting of the search or of Ipopt: another one leads to motions that are as good, later or sooner",
    "validation/samples.py: if abs(gripper.nearest(opening) - opening) > EXACT: | comparison: > → >=": "both differ only where two numbers are the same to the last bit, or a distance is exactly zero, which is neither right nor wrong",
    "solver/between.py: shapes = int(found.pair.max(initial=0)) + 1 | constant: 0 → 1": "any larger number makes keys as unique",
    "validation/samples.py: MOST = 100_000 | constant: 100_000 → 100001": "how many are looked at together, or when what is too long is left alone: the answers are the same",
    "chain/contacts.py: parts = [self.chain.joint_placements(z[row : row + _ROWS]) for row in range(0, max(len(z), 1), _ROWS)] | swapped: len(z), 1 → 1, len(z)": "max(a, b) is max(b, a)",
    "solver/between.py: joined = Contacts(*(np.concatenate(arrays) for arrays in zip(*(part.arrays() for part in parts), strict=True))) | constant: True → False": "`strict=True` asks whether two lists are equally long, which they are by the way they are made",
    "solver/trust_region.py: self.radius = np.maximum(radius, 1e-6)[self.block] | swapped: radius, 1e-6 → 1e-6, radius": "max(a, b) is max(b, a)",
    "validation/sweep.py: todo, reach = todo[~done[todo]], 2.0 * reach | arithmetic: * → /": "how much further is looked next where nothing was near enough: all there is comes sooner, and the answers are the same",
    "solver/between.py: SPACING = 0.02  # [m] or [rad] between the states looked at first, in the coordinate that moves most | constant: 0.02 → 0.04": "a setting of the search or of Ipopt: another one leads to motions that are as good, later or sooner",
    "validation/distances.py: POINT = 1e-4  # [m], radius of a point | constant: 1e-4 → 0.0002": "a point has a size only because coal asks for one; any that is small does",
    "validation/validate.py: begin = np.where(crossed, before / np.where(crossed, before + after, 1.0), 0.0) | constant: 1.0 → 2.0": "the divisor where nothing is crossed, of a quotient that is not taken there",
    "chain/collision_pairs.py: if not lower <= value <= upper: | comparison: <= → < (the same, 2)": "both differ only where two numbers are the same to the last bit, or a distance is exactly zero, which is neither right nor wrong",
    "chain/collision_pairs.py: table[rows[one], 2] = np.minimum(table[rows[one], 2], one.margin) | swapped: table[rows[one], 2], one.margin → one.margin, table[rows[one], 2]": "min(a, b) is min(b, a)",
    "chain/collision_pairs.py: return -np.inf | sign: -np.inf → (np.inf)": "the hand and what it grasps firmly are never a pair: what is not finite is left out, whichever its sign, and a link that is grasped always moves",
    "validation/sweep.py: break | dropped: break → pass": "of what overlaps between two samples one place says so; looking on only takes longer",
    "chain/collision_pairs.py: continue | dropped: continue → pass": "a short cut: of a free object that is held nothing stands, so that the lines below find no shape",
    "validation/goals.py: held = phases[min(end, len(phases) - 1)].held  # from then on | swapped: end, len(phases) - 1 → len(phases) - 1, end": "min(a, b) is min(b, a)",
    "solver/trust_region.py: NO_MATTER = 0.4  # of the merit, in a block: 8 mm of shortfall at the weight that it has at first | constant: 0.4 → 0.8": "a setting of the search or of Ipopt: another one leads to motions that are as good, later or sooner",
    "validation/validate.py: out, ends = max(lower - value, value - upper), self.trajectory.column(name)[worst : worst + 2] | swapped: lower - value, value - upper → value - upper, lower - value": "max(a, b) is max(b, a)",
}
