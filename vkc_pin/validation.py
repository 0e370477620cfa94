"""The independent check of a motion, continuous in time. Numeric Pinocchio and coal only; nothing of the optimiser."""
