"""Plans whole-body trajectories, from scene and steps to a validated plan."""
