"""Planning: from seed to seed and step to step, until the validation accepts a motion."""
