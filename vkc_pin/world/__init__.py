"""States problems and trajectories: files, models, scenes, tasks."""
