"""The same problems for other planners: trajopt, OMPL, roboplan, the two baselines, and this package."""
