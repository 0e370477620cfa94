"""Plans of the experiments' tasks, executed in physics."""
