"""The virtual kinematic chain: its kinematics, and what it can hit."""
