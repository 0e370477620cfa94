"""What the motors have to do along a motion, and what keeps it from being faster."""
